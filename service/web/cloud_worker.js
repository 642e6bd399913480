/** The worker that draws points: to open WebGL and to compile for it takes longer than a frame, and nothing waits here. */

import { Cloud } from "./cloud.js";

const scope = /** @type {Worker} */ (/** @type {unknown} */ (globalThis));
/** @type {?Cloud} */
let cloud = null;

scope.onmessage = (/** @type {MessageEvent<Order | OffscreenCanvas>} */ { data }) => {
	if (data instanceof OffscreenCanvas) {
		const gl = data.getContext("webgl2", { antialias: false, powerPreference: "low-power" });
		if (gl) cloud = new Cloud(data, gl, (drawn) => scope.postMessage({ drawn }));
		else scope.postMessage({ isMissing: true });
	} else {
		const [method, ...about] = data;
		/** @type {any} */ (cloud)?.[method](...about);
	}
};
