/** What a set of photographs of the sheet lacks yet, and the one to take next, in words. */

import { short } from "./numbers.js";
import { upright } from "./photograph_files.js";

export const WANTED = 8;
const COLUMNS = 6;
const ROWS = 4;
const TILTED_DEG = 10;
const WANTED_TILTED = 3;
const WANTED_A_SIDE = 2;
const SIDE = 1.12; // times the focus distance: nearer than 1/1.12 and farther than 1.12 count as a side
const BLURRED_PX = 1.5;
const BLUR_RATIO = 2;
const MOST_BLUR = 1 / 3; // of a circle's radius: in more the grid is hard to find
/** @type {Between} */
const NEARER = [0.6, 0.8];
/** @type {Between} */
const FARTHER = [1.25, 1.7];

/**
 * How many circles were in each part of the frame, which is shown as the newest photograph is held.
 *
 * @param {Seen[]} seen
 * @returns {number[][]} rows of columns
 */
export function coverageOf(seen) {
	const orientation = seen.at(-1)?.orientation ?? 1;
	const isTurned = orientation > 4;
	const [rows, columns] = isTurned ? [COLUMNS, ROWS] : [ROWS, COLUMNS];
	const cells = Array.from({ length: rows }, () => Array(columns).fill(0));
	const place = (/** @type {number} */ at, /** @type {number} */ size, /** @type {number} */ count) =>
		Math.min(count - 1, Math.max(0, Math.floor((at / size) * count)));
	for (const { circles, width, height } of seen) {
		const [across, down] = isTurned ? [height, width] : [width, height];
		for (const { u_px: u, v_px: v } of circles) {
			const [x, y] = upright(u + 0.5, v + 0.5, orientation, width, height);
			cells[place(y, down, rows)][place(x, across, columns)] += 1;
		}
	}
	return cells;
}

/** Where the lens seems to be focused: as told, else the distance of the sharpest photograph. @param {Seen[]} seen @param {?number} told */
export function focusOf(seen, told) {
	if (told !== null) return told;
	const known = seen.filter(({ role, blur, distance }) => role === "defocused" && blur !== null && distance !== null);
	known.sort((a, b) => Number(a.blur) - Number(b.blur));
	return known[0]?.distance ?? null;
}

/** @param {Seen[]} seen @param {?number} toldFocus in metres */
export function adviceFor(seen, toldFocus) {
	const left = WANTED - seen.length;
	const tilted = seen.filter(({ tilt }) => tilt !== null && tilt >= TILTED_DEG).length;
	const tilt = tilted < WANTED_TILTED ? ", tilted by 15 to 25 degrees" : "";
	if (seen.length === 0) {
		return "Begin with one in which the sheet is sharp and fills most of the frame.";
	}
	const side = missingSide(seen, focusOf(seen, toldFocus));
	if (side) return `Next: one ${side}${tilt}.`;
	const corner = missingCorner(coverageOf(seen));
	if (corner && (left > 0 || seen.length < WANTED + 4)) {
		return `Next: one with the sheet towards the ${corner}${tilt}.`;
	}
	const blur = missingBlur(seen);
	if (blur) return `Next: one ${blur}${tilt}.`;
	if (tilt && seen.some((one) => one.tilt !== null)) return `Next: one${tilt}.`;
	if (left > 0) return `Next: ${left === 1 ? "one more" : `${left} more`}, each at another distance and tilt.`;
	return "This is a good set: start the calibration.";
}

/** @param {Seen[]} seen @param {?number} focus in metres @returns {?string} where too few were taken */
function missingSide(seen, focus) {
	const defocused = seen.filter(({ role }) => role === "defocused");
	const distances = defocused.flatMap(({ distance }) => (distance === null ? [] : [distance]));
	if (focus === null || distances.length === 0) {
		// without a focal length there is no distance, but the sheet's size in the frame tells near from far
		const sizes = defocused.map(sizeOf).sort((a, b) => a - b);
		if (sizes.length > 0 && sizes[sizes.length - 1] > sizes[0] * SIDE ** 2) return null;
		// where k_cam is large no sheet is far from focus: what is blurred and larger than the sharpest is nearer
		const clear = clearlyBlurred(defocused);
		const larger = clear.filter((one) => sizeOf(one) > sizeOf(sharpestOf(defocused))).length;
		if (Math.min(larger, clear.length - larger) >= WANTED_A_SIDE) return null;
		const isNearer = clear.length === 0 ? sizes.length % 2 === 0 : larger <= clear.length - larger;
		return isNearer ? "nearer than the plane in focus" : "farther than the plane in focus";
	}
	const clear = clearlyBlurred(defocused);
	const count = (/** @type {(distance: number, edge: number) => boolean} */ isBeyond) =>
		defocused.filter(
			(one) => one.distance !== null && (isBeyond(one.distance, SIDE) || (clear.includes(one) && isBeyond(one.distance, 1))),
		).length;
	const nearer = count((distance, edge) => distance < focus / edge);
	const farther = count((distance, edge) => distance > focus * edge);
	if (nearer >= WANTED_A_SIDE && farther >= WANTED_A_SIDE) return null;
	const isNearer = nearer < WANTED_A_SIDE && nearer <= farther;
	const [low, high] = within(isNearer ? NEARER : FARTHER, reachOf(clear, focus));
	const digits = high < low * SIDE ? 3 : 2;
	return `at ${short(focus * low, digits)}–${short(focus * high, digits)} m`;
}

/** @param {Seen[]} defocused @returns those whose blur tells a side, however near the plane in focus is */
function clearlyBlurred(defocused) {
	const least = Math.min(...defocused.flatMap(({ blur }) => blur ?? []));
	return defocused.filter(({ blur }) => blur !== null && blur >= BLUR_RATIO * least);
}

/** @param {Seen[]} seen not empty */
function sharpestOf(seen) {
	return seen.reduce((best, one) => (Number(one.blur ?? Infinity) < Number(best.blur ?? Infinity) ? one : best));
}

/** Where blur is `MOST_BLUR`, in focus distances from the plane in focus: it grows with |s1/z - 1|, a radius with 1/z. @param {Seen[]} clear @param {number} focus */
function reachOf(clear, focus) {
	const reaches = clear.flatMap(({ circles, blur, distance }) => {
		if (!blur || distance === null || distance === focus) return [];
		const radius = circles.reduce((sum, { radius_px }) => sum + radius_px, 0) / circles.length;
		return [(MOST_BLUR * radius * Math.abs(distance / focus - 1)) / blur];
	});
	reaches.sort((a, b) => a - b);
	return reaches[reaches.length >> 1] ?? Infinity;
}

/** @param {Between} between @param {number} reach from the plane in focus, beyond which none is sent @returns {Between} */
function within([low, high], reach) {
	return high < 1
		? [Math.max(low, 1 - reach), Math.max(high, 1 - reach / 2)]
		: [Math.min(low, 1 + reach / 2), Math.min(high, 1 + reach)];
}

/** @param {Seen[]} seen @returns {?string} what to take where all are blurred alike, which tells k_cam no more than one */
function missingBlur(seen) {
	const blurs = seen.flatMap(({ role, blur }) => (role === "defocused" && blur !== null ? [blur] : []));
	if (blurs.length === 0) return null;
	const most = Math.max(...blurs);
	if (most < BLURRED_PX) return "clearly blurred, with the focus as it is: go much nearer or farther";
	return most < BLUR_RATIO * Math.min(...blurs) ? "in which the sheet is sharper" : null;
}

/** @param {Seen} seen the circles' diagonal as a part of the frame's width */
function sizeOf({ circles, width }) {
	const across = circles.map(({ u_px: u }) => u);
	const down = circles.map(({ v_px: v }) => v);
	return Math.hypot(Math.max(...across) - Math.min(...across), Math.max(...down) - Math.min(...down)) / width;
}

/** @param {number[][]} cells @returns {?string} the first corner without a circle */
function missingCorner(cells) {
	const [top, bottom, last] = [cells[0], cells[cells.length - 1], cells[0].length - 1];
	const corners = /** @type {[string, number[], number[]][]} */ ([
		["upper left corner", top, [0, 1]],
		["upper right corner", top, [last - 1, last]],
		["lower left corner", bottom, [0, 1]],
		["lower right corner", bottom, [last - 1, last]],
	]);
	const found = corners.find(([, row, columns]) => columns.every((column) => row[column] === 0));
	return found ? found[0] : null;
}
