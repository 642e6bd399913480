/** The depth as points in space. */

import { Switch } from "./colour_controls.js";
import { html, useEffect, useRef, useState } from "./vendor/preact.js";

const MOST_POINTS = 300_000;
const ZOOM = 1.25;
const TURN = 0.05;
const MOST_DENSE = 2;
/** @type {Record<string, Order>} */
const KEYS = {
	ArrowLeft: ["orbit", -TURN, 0],
	ArrowRight: ["orbit", TURN, 0],
	ArrowUp: ["orbit", 0, -TURN],
	ArrowDown: ["orbit", 0, TURN],
	"+": ["zoom", ZOOM],
	"=": ["zoom", ZOOM],
	"-": ["zoom", 1 / ZOOM],
	0: ["reset"],
	Home: ["reset"],
};

/** @param {CloudViewProps} props */
export function CloudView({ reader, result, look, hasPhotograph, isShown }) {
	const canvas = useRef(/** @type {?HTMLCanvasElement} */ (null));
	const [tell, setTell] = useState(/** @type {{to: Tell} | null} */ (null));
	const [isMissing, setIsMissing] = useState(false);
	const [isPhotograph, setIsPhotograph] = useState(true);
	const isOfPhotograph = isPhotograph && hasPhotograph;
	const { hasPoints } = result.facts;
	// the colours of a photograph are the same however the depth is coloured
	const { map, nearM, farM } = look;
	const coloured = isOfPhotograph ? "" : `${map} ${nearM} ${farM}`;

	// at once and not when it is wanted: opening WebGL is the longest part of the first picture
	useEffect(() => {
		if (!canvas.current) return undefined;
		const worker = drawOn(canvas.current, () => setIsMissing(true));
		if (worker === null) return setIsMissing(true);
		const to = (/** @type {Order} */ order, /** @type {Transferable[]} */ parts = []) => worker.postMessage(order, parts);
		setTell({ to });
		const end = handle(canvas.current, to);
		return () => {
			end();
			worker.terminate();
		};
	}, [hasPoints]);

	useEffect(() => {
		if (!isShown || tell === null) return;
		reader
			.ask("cloud", { most: MOST_POINTS, look, isPhotograph: isOfPhotograph })
			.then((points) => tell.to(["show", points], [points.positions.buffer, points.colours.buffer]));
	}, [tell, isShown, result, isOfPhotograph, coloured]);

	if (!hasPoints || isMissing) {
		return html`<div class="drop">
			<p>
				${hasPoints
					? "This browser has no WebGL2, no graphics to draw it with, or only a part of the page: load it again. The points are there as PLY, to download."
					: "Points in space need the camera's focal length."}
			</p>
		</div>`;
	}
	const act = (/** @type {Order} */ order) => () => tell?.to(order);
	return html`<div class="stack">
		<canvas
			ref=${canvas}
			class="depth-cloud"
			tabindex="0"
			role="application"
			aria-label="Points in space"
			aria-describedby="depth-cloud-hint"
		></canvas>
		<div class="row">
			<button onClick=${act(["zoom", ZOOM])} aria-label="Nearer">+</button>
			<button onClick=${act(["zoom", 1 / ZOOM])} aria-label="Farther">−</button>
			<button onClick=${act(["reset"])}>Reset view</button>
			${hasPhotograph &&
			html`<${Switch} title="Photograph's colours" isOn=${isPhotograph} onSwitch=${setIsPhotograph} />`}
		</div>
		<p id="depth-cloud-hint" class="hint">
			Drag to turn, wheel or pinch to come nearer. By keys: arrows turn, + and − come nearer and go away, 0 resets.
		</p>
	</div>`;
}

/**
 * @param {HTMLCanvasElement} canvas which is the worker's from now on
 * @param {() => void} onMissing where there is no WebGL2, or no worker
 * @returns {?Worker} null where a worker cannot draw
 */
function drawOn(canvas, onMissing) {
	if (!canvas.transferControlToOffscreen) return null;
	const worker = new Worker(new URL("cloud_worker.js", import.meta.url), { type: "module" });
	worker.onerror = onMissing;
	worker.onmessage = ({ data }) => {
		if (data.isMissing) onMissing();
		else canvas.dataset.points = data.drawn;
	};
	const drawn = canvas.transferControlToOffscreen();
	worker.postMessage(drawn, [drawn]);
	return worker;
}

/** Size, pointers, wheel and keys for the view. @param {HTMLCanvasElement} canvas @param {Tell} tell @returns {() => void} what ends it */
function handle(canvas, tell) {
	const sized = new ResizeObserver(([{ contentRect }]) => {
		const dense = Math.min(MOST_DENSE, devicePixelRatio);
		const [width, height] = [contentRect.width, contentRect.height].map((length) => Math.round(length * dense));
		if (width > 0) tell(["resize", width, height]);
	});
	sized.observe(canvas);
	/** @type {Map<number, {x: number, y: number}>} */
	const pointers = new Map();
	const apart = () => {
		const [one, other] = pointers.values();
		return Math.hypot(one.x - other.x, one.y - other.y);
	};
	const end = new AbortController();
	/** @template {keyof HTMLElementEventMap} K @param {K} name @param {(event: HTMLElementEventMap[K]) => void} listener */
	const on = (name, listener) => canvas.addEventListener(name, listener, { signal: end.signal, passive: false });
	on("pointerdown", (event) => {
		canvas.setPointerCapture(event.pointerId);
		pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
	});
	on("pointermove", (event) => {
		const before = pointers.get(event.pointerId);
		if (!before) return;
		const wasApart = pointers.size === 2 ? apart() : 0;
		pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
		if (pointers.size === 2) tell(["zoom", apart() / wasApart]);
		else tell(["orbit", (event.clientX - before.x) / canvas.clientHeight, (event.clientY - before.y) / canvas.clientHeight]);
	});
	for (const name of /** @type {const} */ (["pointerup", "pointercancel"])) {
		on(name, (event) => pointers.delete(event.pointerId));
	}
	on("wheel", (event) => {
		event.preventDefault();
		tell(["zoom", Math.exp(-event.deltaY / 500)]);
	});
	on("keydown", (event) => {
		if (!(event.key in KEYS) || event.altKey || event.ctrlKey || event.metaKey) return;
		event.preventDefault();
		tell(KEYS[event.key]);
	});
	return () => {
		sized.disconnect();
		end.abort();
	};
}
