/** The photograph under its depth, with the divider between them, the pointer's reading and the two marks. */

import { inMetres, withError } from "./numbers.js";
import { latest } from "./reader.js";
import { sideOf } from "./readout.js";
import { html, useEffect, useMemo, useRef, useState } from "./vendor/preact.js";
import { useWidth } from "./width.js";

const MOST_PX = 2000;
const DIVIDER_REACH_PX = 14;
const CLICK_PX = 3; // what moves less is no drag
const LARGE_STEPS = 20;
const STILL_MS = 500;
const HINT = "depth-stage-hint";

/** @param {StageProps} props */
export function Stage({
	reader, size, look, bitmap, result, reading, marks, measured, known, onReading, onMarks, onCounts, announce,
}) {
	const [stage, width] = useWidth(0);
	const [divider, setDivider] = useState(0);
	const [painted, setPainted] = useState(/** @type {?ImageBitmap} */ (null));
	// as wide as it is shown, in the screen's pixels
	const most = (MOST_PX * size.width) / Math.max(size.width, size.height);
	const paintPx = Math.round(Math.min(most, width * devicePixelRatio));
	const drag = useRef(/** @type {{x: number, y: number, hasMoved: boolean} | null} */ (null));
	const isByKeys = useRef(false);

	const paint = useMemo(
		() =>
			latest(async (/** @type {{look: typeof look, width: number, height: number}} */ about) => {
				const { bitmap: next, counts } = await reader.ask("paint", about);
				setPainted(next);
				onCounts(counts);
			}),
		[],
	);
	useEffect(() => {
		if (result && paintPx > 0) {
			paint({ look, width: paintPx, height: Math.round((size.height * paintPx) / size.width) || 1 });
		} else {
			setPainted(null);
		}
	}, [result, look, paintPx]);

	const read = useMemo(
		() => latest(async (/** @type {?Pixel} */ pixel) => onReading(pixel && (await reader.ask("at", pixel)))),
		[],
	);

	useEffect(() => {
		if (!isByKeys.current || reading === null) return undefined;
		const timer = setTimeout(() => announce(spoken(reading, result?.focusM ?? 0)), STILL_MS);
		return () => clearTimeout(timer);
	}, [reading]);

	const boxOf = () => /** @type {HTMLElement} */ (stage.current).getBoundingClientRect();

	const within = (/** @type {number} */ u, /** @type {number} */ v) => ({
		u: Math.min(size.width - 1, Math.max(0, Math.floor(u))),
		v: Math.min(size.height - 1, Math.max(0, Math.floor(v))),
	});

	const pixelAt = (/** @type {PointerEvent} */ { clientX, clientY }) => {
		const { left, top, width, height } = boxOf();
		return within(((clientX - left) / width) * size.width, ((clientY - top) / height) * size.height);
	};

	/** @param {PointerEvent} event */
	function onPointerDown(event) {
		const box = boxOf();
		const at = box.left + (divider / 100) * box.width;
		const { clientX: x, clientY: y } = event;
		drag.current = Math.abs(x - at) < DIVIDER_REACH_PX ? { x, y, hasMoved: false } : null;
		isByKeys.current = false;
		if (drag.current === null) return;
		stage.current?.setPointerCapture(event.pointerId);
		event.preventDefault();
	}

	/** @param {PointerEvent} event */
	function onPointerMove(event) {
		if (drag.current) {
			const box = boxOf();
			drag.current.hasMoved ||= Math.hypot(event.clientX - drag.current.x, event.clientY - drag.current.y) >= CLICK_PX;
			if (drag.current.hasMoved) setDivider(Math.min(100, Math.max(0, (100 * (event.clientX - box.left)) / box.width)));
		} else {
			isByKeys.current = false;
			if (result) read(pixelAt(event));
		}
	}

	/** @param {PointerEvent} event */
	function onPointerUp(event) {
		const hasMoved = drag.current?.hasMoved;
		drag.current = null;
		if (hasMoved || !result || event.button !== 0) return;
		read(pixelAt(event));
		mark(pixelAt(event));
	}

	/** What was marked is read again: the pointer has left, or what began as one was a finger that scrolls. */
	const leave = () => result && read(marks.at(-1) ?? null);

	/** @param {Pixel} pixel a third one begins anew */
	function mark(pixel) {
		onMarks(marks.length === 1 ? [marks[0], pixel] : [pixel]);
		announce(`Marked ${pixel.u}, ${pixel.v}.`);
	}

	/** @param {KeyboardEvent} event */
	function onKeyDown(event) {
		if (!result || event.altKey || event.ctrlKey || event.metaKey) return;
		const { u, v } = reading ?? marks.at(-1) ?? { u: size.width >> 1, v: size.height >> 1 };
		const step = event.shiftKey ? Math.ceil(Math.max(size.width, size.height) / LARGE_STEPS) : 1;
		const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
		const move = /** @type {Record<string, number[]>} */ (moves)[event.key];
		if (move) {
			const [across, down] = reading ? move : [0, 0];
			isByKeys.current = true;
			read(within(u + across, v + down));
		} else if ((event.key === "Enter" || event.key === " ") && reading) {
			mark({ u, v });
		} else if (event.key === "Escape") {
			onMarks([]);
			onReading(null);
			announce("Cleared.");
		} else {
			return;
		}
		event.preventDefault();
	}

	const portion = `${divider}%`;
	return html`
		<div
			ref=${stage}
			class=${`depth-stage ${result ? "depth-ready" : ""}`}
			style=${{ aspectRatio: `${size.width} / ${size.height}`, maxWidth: `calc(78vh * ${size.width / size.height})` }}
			...${result && { tabindex: 0, role: "application", "aria-label": "Depth of the photograph", "aria-describedby": HINT }}
			...${{ onPointerDown, onPointerMove, onPointerUp, onKeyDown }}
			onPointerCancel=${leave}
			onPointerLeave=${(event) => event.pointerType === "mouse" && !isByKeys.current && leave()}
		>
			<${Bitmap} bitmap=${bitmap} name="photograph" />
			<div class="depth-over" style=${{ clipPath: `inset(0 0 0 ${portion})` }} hidden=${painted === null}>
				<${Bitmap} bitmap=${painted} name="depth" />
			</div>
			${result &&
			html`<div class="depth-divider" style=${{ left: portion }} aria-hidden="true"></div>
				<${Marks} ...${{ size, reading, marks, measured, known }} />`}
		</div>
		${result &&
		html`<label class="depth-slide"
				><span>Depth</span>
				<input
					type="range"
					min="0"
					max="100"
					value=${divider}
					aria-label="Part of the picture that shows the photograph"
					onInput=${(event) => setDivider(Number(event.target.value))}
				/><span>Photograph</span></label
			>
			<p id=${HINT} class="hint">
				Point to read metres, click two points for their distance. By keys: arrows move the cross (Shift: far), Enter marks,
				Escape clears.
			</p>`}
	`;
}

/** @param {{bitmap: ImageBitmap | null, name: string}} props */
function Bitmap({ bitmap, name }) {
	const canvas = useRef(/** @type {?HTMLCanvasElement} */ (null));
	useEffect(() => {
		if (!bitmap || !canvas.current) return;
		canvas.current.width = bitmap.width;
		canvas.current.height = bitmap.height;
		// not drawn but handed over; what it was handed before is freed
		canvas.current.getContext("bitmaprenderer")?.transferFromImageBitmap(bitmap);
	}, [bitmap]);
	return html`<canvas ref=${canvas} data-picture=${name} hidden=${bitmap === null}></canvas>`;
}

/**
 * What is drawn on the picture; it is said in words beside it.
 *
 * @param {Pick<Parameters<typeof Stage>[0], "size" | "reading" | "marks" | "measured" | "known">} props
 */
function Marks({ size, reading, marks, measured, known }) {
	const x = (/** @type {number} */ u) => `${((100 * (u + 0.5)) / size.width).toFixed(3)}%`;
	const y = (/** @type {number} */ v) => `${((100 * (v + 0.5)) / size.height).toFixed(3)}%`;
	const ring = (/** @type {Pixel} */ { u, v }, /** @type {number} */ r, /** @type {string} */ line) =>
		["rim", line].map((kind) => html`<circle class=${kind} cx=${x(u)} cy=${y(v)} r=${r} />`);
	const [from, to] = marks;
	const end = to ?? reading;
	return html`
		<svg class="depth-marks" aria-hidden="true">
			${from &&
			end &&
			["rim", "line"].map(
				(kind) =>
					html`<line key=${kind} class=${kind} x1=${x(from.u)} y1=${y(from.v)} x2=${x(end.u)} y2=${y(end.v)} />`,
			)}
			${known.map((one) => ring(one, 4, "line depth-taped"))} ${marks.map((one) => ring(one, 6, "line"))}
			${reading &&
			["rim", "line"].map(
				(kind) => html`<g key=${kind} class="depth-cross">
					<line class=${kind} x1="0" y1=${y(reading.v)} x2="100%" y2=${y(reading.v)} />
					<line class=${kind} x1=${x(reading.u)} y1="0" x2=${x(reading.u)} y2="100%" />
				</g>`,
			)}
		</svg>
		${reading &&
		html`<${Label}
			left=${(reading.u + 0.5) / size.width}
			top=${(reading.v + 0.5) / size.height}
			isBelow=${reading.v < 0.85 * size.height}
			name="reading"
		>
			${reading.depthM === null ? "no answer" : `${withError(reading.depthM, reading.sigmaM)} along the axis`}
		<//>`}
		${to &&
		measured &&
		html`<${Label}
			left=${((from.u + to.u) / 2 + 0.5) / size.width}
			top=${((from.v + to.v) / 2 + 0.5) / size.height}
			isBelow=${from.v + to.v < 0.3 * size.height}
			name="distance"
		>
			${withError(measured.distanceM, measured.sigmaM)}
		<//>`}
	`;
}

/** Words above or below a place, as far to its left as keeps them inside the picture. @param {LabelProps} props */
function Label({ left, top, isBelow, name, children }) {
	const across = `${-100 * left}%`;
	const down = isBelow ? "10px" : "calc(-100% - 10px)";
	const style = { left: `${100 * left}%`, top: `${100 * top}%`, transform: `translate(${across}, ${down})` };
	return html`<span class="depth-label" data-label=${name} style=${style} aria-hidden="true">${children}</span>`;
}

/** @param {Reading} reading @param {number} focusM */
function spoken(reading, focusM) {
	const { u, v, depthM, sigmaM, rayLength } = reading;
	if (depthM === null) return `No answer at ${u}, ${v}.`;
	const straight = rayLength === null ? "" : ` Straight from the lens ${inMetres(depthM * rayLength)} metres.`;
	return `${inMetres(depthM)} metres along the axis, give or take ${inMetres(sigmaM ?? 0, depthM)}, ${sideOf(depthM, reading, focusM)}, at ${u}, ${v}.${straight}`;
}
