/** The worker that keeps a photograph's maps and does everything that takes longer than a frame. */

import { DepthMaps } from "./maps.js";

/** @type {?DepthMaps} */
let maps = null;
/** @type {?ImageData} */
let photograph = null;

function loaded() {
	if (maps === null) throw new Error("No maps are loaded.");
	return maps;
}

const WORK = {
	/** @param {{npz: Blob, at: {u: number, v: number} | null}} about */
	async load({ npz, at }) {
		maps = null; // two photographs' maps at a time may be more than a phone has
		maps = await DepthMaps.read(npz);
		return { facts: maps.facts(), reading: at && maps.at(at.u, at.v) };
	},

	/**
	 * @param {{file: Blob, mostPx: number}} about
	 * @returns {Promise<{bitmap: ImageBitmap, width: number, height: number} | null>} upright, at most so large on its
	 *   longer side, with its true size; null where the browser cannot read it
	 */
	async photograph({ file, mostPx }) {
		photograph = null;
		const whole = await createImageBitmap(file).catch(() => null);
		if (whole === null) return null;
		const { width, height } = whole;
		const scale = Math.min(1, mostPx / Math.max(width, height));
		const canvas = new OffscreenCanvas(Math.round(width * scale) || 1, Math.round(height * scale) || 1);
		const context = canvasContext(canvas);
		context.imageSmoothingQuality = "high";
		context.drawImage(whole, 0, 0, canvas.width, canvas.height);
		whole.close();
		photograph = context.getImageData(0, 0, canvas.width, canvas.height);
		return { bitmap: canvas.transferToImageBitmap(), width, height };
	},

	/** @param {{look: Look, width: number, height: number}} about */
	async paint({ look, width, height }) {
		const { pixels, counts } = loaded().paint(look, width, height);
		const canvas = new OffscreenCanvas(width, height);
		canvasContext(canvas).putImageData(pixels, 0, 0);
		return { bitmap: canvas.transferToImageBitmap(), counts };
	},

	/** @param {{u: number, v: number}} pixel */
	async at({ u, v }) {
		return loaded().at(u, v);
	},

	/** @param {{from: {u: number, v: number}, to: {u: number, v: number}}} ends */
	async distance({ from, to }) {
		return loaded().distance(from, to);
	},

	/** @param {{most: number, look: Look, isPhotograph: boolean}} about */
	async cloud({ most, look, isPhotograph }) {
		return loaded().cloud(most, look, isPhotograph ? photograph : null);
	},
};

/** @typedef {typeof WORK} Work */

/** @param {OffscreenCanvas} canvas */
function canvasContext(canvas) {
	const context = canvas.getContext("2d", { willReadFrequently: true });
	if (context === null) throw new Error("This browser gives a worker no canvas.");
	return context;
}

/** @param {any} result */
function transferable(result) {
	return [result?.bitmap, result?.positions?.buffer, result?.colours?.buffer].filter(Boolean);
}

const scope = /** @type {Worker} */ (/** @type {unknown} */ (globalThis));

/** @param {MessageEvent} message */
async function answer({ data: { id, kind, about } }) {
	try {
		const result = await WORK[/** @type {keyof Work} */ (kind)](about);
		scope.postMessage({ id, result }, transferable(result));
	} catch (error) {
		scope.postMessage({ id, failure: error instanceof Error ? error.message : String(error) });
	}
}

// one after the other, so that nothing is read from maps that another photograph's are about to replace
let before = Promise.resolve();
scope.onmessage = (message) => {
	before = before.then(() => answer(message));
};
