/** The page's frame: tabs by location hash, the cameras that all of them use, the API key, and what is said aloud. */

import { KEY_CHANGED, everyCamera, forgetKey, problemOf, storedKey } from "./api.js";
import { CalibrateView } from "./calibrate.js";
import { CamerasView } from "./cameras.js";
import { DepthView } from "./depth.js";
import "./focus.js";
import { KeyDialog } from "./key_dialog.js";
import { ProblemBox, useProblem } from "./problem_box.js";
import { StatusView } from "./status.js";
import { html, render, useCallback, useEffect, useRef, useState } from "./vendor/preact.js";

/** @type {{tab: Tab, title: string, View: (props: ViewProps) => any}[]} */
const TABS = [
	{ tab: "depth", title: "Depth", View: DepthView },
	{ tab: "cameras", title: "Cameras", View: CamerasView },
	{ tab: "calibrate", title: "Calibrate", View: CalibrateView },
	{ tab: "status", title: "Status", View: StatusView },
];

/** @returns {{tab: Tab, camera: string | null}} from `#tab` or `#tab/camera` */
function readHash() {
	const [name, camera = null] = location.hash.slice(1).split("/", 2);
	const known = TABS.find(({ tab }) => tab === name) ?? TABS[0];
	try {
		return { tab: known.tab, camera: camera && decodeURIComponent(camera) };
	} catch {
		return { tab: known.tab, camera: null };
	}
}

/** @param {Tab} tab @param {?string} [camera] */
const hashOf = (tab, camera) => (camera ? `#${tab}/${encodeURIComponent(camera)}` : `#${tab}`);

/** @type {ViewProps["go"]} */
function go(tab, { camera, replaces = false } = {}) {
	const hash = hashOf(tab, camera);
	if (!replaces) location.hash = hash;
	else if (hash !== location.hash) {
		history.replaceState(null, "", hash);
		dispatchEvent(new Event("hashchange"));
	}
}

function useHash() {
	const [place, setPlace] = useState(readHash);
	useEffect(() => {
		const read = () => {
			const found = readHash();
			setPlace(found);
			// it is brought once: on the way back it would take the place of what was typed since
			if (found.tab === "calibrate") history.replaceState(null, "", "#calibrate");
		};
		read();
		addEventListener("hashchange", read);
		return () => removeEventListener("hashchange", read);
	}, []);
	return place;
}

function App() {
	const place = useHash();
	const at = TABS.findIndex(({ tab }) => tab === place.tab);
	useEffect(() => {
		document.title = [place.camera, TABS[at].title, "camind"].filter(Boolean).join(" · ");
	}, [place]);
	/** The camera in each tab's address when it was left. */
	const left = useRef(/** @type {Partial<Record<Tab, string | null>>} */ ({})).current;
	if (place.tab !== "calibrate") left[place.tab] = place.camera;
	const [cameras, setCameras] = useState(/** @type {any[] | null} */ (null));
	const [problem, setProblem] = useProblem();
	const [said, setSaid] = useState("");
	const [hasKey, setHasKey] = useState(storedKey() !== null);

	const reloadCameras = useCallback(async ({ asks = true, stored = /** @type {any} */ (null) } = {}) => {
		try {
			setCameras(await everyCamera({ asks }));
			setProblem(null);
		} catch (error) {
			const met = problemOf(error);
			if (asks) setProblem(met);
			if (stored) setCameras((before) => before && [...before.filter(({ name }) => name !== stored.name), stored]);
		}
	}, []);
	const announce = useCallback((/** @type {string} */ text) => {
		// the same words again are said again
		setSaid((before) => (before === text ? `${text}\u00a0` : text));
	}, []);
	useEffect(() => {
		reloadCameras();
		// some may have been made or changed elsewhere
		const look = () => document.hidden || reloadCameras({ asks: false });
		document.addEventListener("visibilitychange", look);
		return () => document.removeEventListener("visibilitychange", look);
	}, []);
	useEffect(() => {
		function onKeyChanged() {
			setHasKey(storedKey() !== null);
			if (storedKey() && (problem ?? cameras)) reloadCameras();
		}
		addEventListener(KEY_CHANGED, onKeyChanged);
		return () => removeEventListener(KEY_CHANGED, onKeyChanged);
	}, [problem, cameras]);

	/** @param {KeyboardEvent} event */
	function onKeyDown(event) {
		const to = { ArrowLeft: at - 1, ArrowRight: at + 1, Home: 0, End: TABS.length - 1, " ": at }[event.key];
		if (to === undefined || event.altKey || event.ctrlKey || event.metaKey) return;
		event.preventDefault();
		const { tab } = TABS[(to + TABS.length) % TABS.length];
		go(tab, { camera: left[tab] });
		document.getElementById(`tab-${tab}`)?.focus();
	}

	return html`
		<header class="bar">
			<h1><a href="#depth">camind</a></h1>
			<nav role="tablist" aria-label="Parts of the page" onKeyDown=${onKeyDown}>
				${TABS.map(
					({ tab, title }) => html`<a
						key=${tab}
						id=${`tab-${tab}`}
						role="tab"
						href=${hashOf(tab, left[tab])}
						aria-selected=${tab === place.tab}
						aria-controls=${`panel-${tab}`}
						tabindex=${tab === place.tab ? 0 : -1}
						>${title}</a
					>`,
				)}
			</nav>
			${hasKey &&
			html`<button
				class="quiet"
				onClick=${() => {
					forgetKey();
					location.reload();
				}}
			>
				Forget API key
			</button>`}
		</header>
		<main>
			<${ProblemBox} problem=${problem} onRetry=${reloadCameras} />
			${TABS.map(
				({ tab, View }) => html`<section
					key=${tab}
					id=${`panel-${tab}`}
					role="tabpanel"
					aria-labelledby=${`tab-${tab}`}
					hidden=${tab !== place.tab}
				>
					<${View}
						shown=${tab === place.tab}
						camera=${tab === place.tab ? place.camera : null}
						lacksCameras=${cameras === null && problem !== null}
						...${{ cameras, reloadCameras, go, announce }}
					/>
				</section>`,
			)}
		</main>
		<p class="visually-hidden" role="status" aria-live="polite">${said}</p>
		<${KeyDialog} />
	`;
}

// what misses its place must not be opened instead of the page, which would be lost
for (const kind of /** @type {const} */ (["dragover", "drop"])) {
	document.addEventListener(kind, (event) => {
		const isAtHome = /** @type {HTMLInputElement} */ (event.target).type === "file";
		if (!isAtHome && event.dataTransfer?.types.includes("Files")) event.preventDefault();
	});
}
render(html`<${App} />`, document.body);
