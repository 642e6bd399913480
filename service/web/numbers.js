/** Numbers as people read them. */

const CLOSE_M = 0.5;
const CLOSE_DIGITS = 4;

/** @param {number | null | undefined} value @param {number} [digits] significant ones @returns {string} a dash for none */
export function short(value, digits = 3) {
	if (value === null || value === undefined || !Number.isFinite(value)) return "–";
	return String(Number(value.toPrecision(digits)));
}

/** @param {?number} value @param {string} unit with the space before it, where there is one @param {number} [digits] */
export function measure(value, unit, digits = 3) {
	return value === null ? "–" : short(value, digits) + unit;
}

/** Metres to a millimetre, close things to four digits. @param {number} value @param {number} [like] that it has as many decimals as */
export function inMetres(value, like = value) {
	const isClose = like > 0 && like < CLOSE_M;
	return value.toFixed(isClose ? CLOSE_DIGITS - 1 - Math.floor(Math.log10(like)) : 3);
}

/** @param {number} depthM @param {?number} sigmaM */
export function withError(depthM, sigmaM) {
	return `${inMetres(depthM)} m ± ${inMetres(sigmaM ?? 0, depthM)} m`;
}

/** @param {number} count @param {string} one @param {string} [many] */
export function counted(count, one, many = `${one}s`) {
	return `${count} ${count === 1 ? one : many}`;
}

/** @param {string} text as it is typed, with a point or a comma */
export function decimal(text) {
	return Number(text.replace(",", "."));
}

/** @param {string} text @returns {number | null | undefined} null for none, undefined for what is no distance */
export function toMetres(text) {
	if (text.trim() === "") return null;
	const value = decimal(text);
	return Number.isFinite(value) && value > 0 ? value : undefined;
}

/** @param {string} time in ISO 8601 */
export function when(time) {
	return new Date(time).toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
}
