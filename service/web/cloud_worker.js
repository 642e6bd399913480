/** The worker that draws points: to open WebGL and to compile for it takes longer than a frame, and nothing waits here. */

import { Cloud } from "./cloud.js";

/** @typedef {{kind: "open", canvas: OffscreenCanvas}} Opening */
/**
 * @typedef {{kind: "show", points: import("./cloud.js").Points} | {kind: "resize", width: number, height: number}
 *   | {kind: "orbit", right: number, down: number} | {kind: "zoom", factor: number} | {kind: "reset"}} Order
 */

const scope = /** @type {Worker} */ (/** @type {unknown} */ (globalThis));
/** @type {Cloud | null} */
let cloud = null;

scope.onmessage = (/** @type {MessageEvent<Opening | Order>} */ { data }) => {
	if (data.kind === "open") {
		cloud = Cloud.on(data.canvas, (count) => scope.postMessage({ drawn: count }));
		if (cloud === null) scope.postMessage({ isMissing: true });
	} else if (data.kind === "show") {
		cloud?.show(data.points);
	} else if (data.kind === "resize") {
		cloud?.resize(data.width, data.height);
	} else if (data.kind === "orbit") {
		cloud?.orbit(data.right, data.down);
	} else if (data.kind === "zoom") {
		cloud?.zoom(data.factor);
	} else {
		cloud?.reset();
	}
};
