/** Files that are photographs, of which browsers do not show every kind. */

import { getBlob } from "./api.js";

export const PHOTOGRAPHS = "image/*,.heic,.heif,.hif,.dng,.cr2,.nef,.arw";

/** @param {File} file */
export function mediaTypeOf(file) {
	// the service looks at the bytes where no kind is told
	return file.type.startsWith("image/") ? file.type : "application/octet-stream";
}

/** The request that sends one. @param {File} file */
export function sending(file) {
	return { method: "POST", headers: { "Content-Type": mediaTypeOf(file) }, body: file };
}

/**
 * What `read` makes of a photograph, or of the service's JPEG of one that the browser does not show.
 *
 * @template T
 * @param {File} file
 * @param {number} longestPx
 * @param {(shown: Blob) => Promise<T | null>} read
 * @param {AbortSignal} signal
 */
export async function readShown(file, longestPx, read, signal) {
	const found = await read(file);
	if (found !== null) return found;
	const about = { ...sending(file), asks: false, signal };
	const preview = await getBlob(`photographs/preview?longest_px=${longestPx}`, about).catch(() => null);
	return preview && read(preview);
}

/**
 * A place of the stored frame in the upright photograph.
 *
 * @param {number} x
 * @param {number} y
 * @param {number} orientation of EXIF
 * @param {number} width of the stored frame
 * @param {number} height
 */
export function upright(x, y, orientation, width, height) {
	const [left, up] = [width - x, height - y];
	return /** @type {[number, number][]} */ ([[x, y], [left, y], [left, up], [x, up], [y, x], [up, x], [up, left], [y, left]])[orientation - 1];
}
