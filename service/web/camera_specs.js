/** A camera between its forms: what the API answers, what it takes, and the fields a person fills in. */

import { decimal, short, toMetres } from "./numbers.js";

const SIZE = ["image_width_px", "image_height_px"];
const LENS = ["focal_length_mm", "f_number", "pixel_pitch_um", "sensor_width_px", "k_r"];
const K_CAM = ["k_cam_px", "f_number"];
const PINHOLE = ["fx_px", "fy_px", "cx_px", "cy_px"];
const NEEDED = {
	"image_width_px": "image width",
	"image_height_px": "image height",
	"focus_distance_m": "focus distance",
};
const NEEDED_OF_LENS = {
	"lens/focal_length_mm": "focal length",
	"lens/f_number": "f-number",
	"lens/pixel_pitch_um": "pixel pitch",
	"lens/sensor_width_px": "sensor width",
};

const NUMBER = /^[-+]?(\d+([.,]\d+)?|\d+\.|\.\d+)(e[-+]?\d+)?$/i;

/** What is asked for as a sensor's width. */
export const SENSOR_WIDTH = "pixels across the full-size photograph the camera takes";

/** Times the focus distance: what is nearer or farther has no answer (the model's `depth_ratio`). */
const ANSWERED = [0.15, 8];

/** What is focused farther is read as by the camera that blurs alike and is focused here. */
const FARTHEST_FOCUS_M = 5;

/** @param {any} camera as the API reads or previews it @returns {[number, number] | null} where its depths are good, in metres */
export function usableM({ range_m, focus_distance_m }) {
	const readM = Math.min(focus_distance_m, FARTHEST_FOCUS_M);
	const near = Math.max(range_m.near, 1 / (1 / (ANSWERED[0] * readM) - 1 / readM + 1 / focus_distance_m));
	const far = Math.min(range_m.far, ANSWERED[1] * focus_distance_m);
	return near < far ? [near, far] : null;
}

/** The fields of a camera that is not there yet. @type {Fields} */
export const BLANK = { "by": "lens", "gamma_px": "0.5", "lens/k_r": "4" };

/** What `POST /cameras` takes, of a camera that the API answered. @param {any} camera */
export function specsOf(camera) {
	const { name, image_width_px, image_height_px, focus_distance_m, k_cam_px, f_number, gamma_px, lens } = camera;
	const { intrinsics = null, description = null } = camera;
	const blur = lens ? { lens } : { k_cam_px, f_number };
	return { name, description, image_width_px, image_height_px, focus_distance_m, ...blur, gamma_px, intrinsics };
}

/** Those of a camera or result, in words. @param {any} of */
export function intrinsicsIn({ intrinsics }) {
	const pinhole = PINHOLE.map((name) => `${name.slice(0, 2)} ${short(intrinsics[name], 5)}`);
	const terms = intrinsics.distortion.map((/** @type {number} */ term) => short(term));
	return `${pinhole.join(", ")} px; distortion ${terms.join(", ") || "none"}`;
}

/** @param {any} camera as the API answers or takes it; what is null stays empty @returns {Fields} */
export function fieldsOf(camera) {
	/** @type {Fields} */
	const fields = { ...BLANK, by: camera.lens ? "lens" : "k_cam" };
	const fill = (/** @type {string} */ path, /** @type {unknown} */ value) => {
		if (value !== null && value !== undefined) fields[path] = String(value);
	};
	for (const name of ["name", "description", ...Object.keys(NEEDED), "gamma_px"]) fill(name, camera[name]);
	if (camera.lens) for (const name of LENS) fill(`lens/${name}`, camera.lens[name]);
	else for (const name of K_CAM) fill(name, camera[name]);
	if (camera.intrinsics) {
		for (const name of PINHOLE) fill(`intrinsics/${name}`, camera.intrinsics[name]);
		fill("intrinsics/distortion", (camera.intrinsics.distortion ?? []).join(", "));
	}
	return fields;
}

/**
 * The fields with what a photograph tells. It tells neither gamma nor k_r, which may have been measured, of intrinsics
 * not the ones of another picture size, and of the sensor's width nothing that is not more than its own.
 *
 * @param {Fields} before
 * @param {any} draft
 * @returns {Fields}
 */
export function filledIn(before, draft) {
	const told = fieldsOf({ ...draft, name: before.name || draft.name });
	const isAnotherSize = SIZE.some((name) => before[name] && before[name] !== told[name]);
	const kept = Object.entries(before).filter(([path]) => !(isAnotherSize && path.startsWith("intrinsics/")));
	const { gamma_px, "lens/k_r": k_r } = { ...BLANK, ...before };
	const sensor = "lens/sensor_width_px";
	if (before[sensor] && !(draft.lens.sensor_width_px > draft.image_width_px)) told[sensor] = before[sensor];
	return { ...Object.fromEntries(kept), ...told, gamma_px, "lens/k_r": k_r, by: "lens" };
}

/** @param {Fields} fields @returns {any} the body for the API, which says itself what is no number */
export function bodyOf(fields) {
	const text = (/** @type {string} */ path) => (fields[path] ?? "").trim();
	const number = (/** @type {string} */ path) => toNumber(text(path));
	/** @type {any} */
	const body = { name: text("name") || null, description: text("description") || null };
	for (const path of [...Object.keys(NEEDED), "gamma_px"]) if (text(path)) body[path] = number(path);
	if (fields.by === "lens") {
		body.lens = Object.fromEntries(LENS.filter((name) => text(`lens/${name}`)).map((name) => [name, number(`lens/${name}`)]));
	} else {
		for (const name of K_CAM) if (text(name)) body[name] = number(name);
	}
	const pinhole = PINHOLE.filter((name) => text(`intrinsics/${name}`));
	const distortion = text("intrinsics/distortion");
	if (pinhole.length > 0 || distortion) {
		body.intrinsics = Object.fromEntries(pinhole.map((name) => [name, number(`intrinsics/${name}`)]));
		body.intrinsics.distortion = numbersOf(distortion) ?? [distortion];
	}
	return body;
}

/** @param {Fields} fields @returns {string[]} the names of what must be filled in before anything can be said of the camera */
export function missingOf(fields) {
	const needed = { ...NEEDED, ...(fields.by === "lens" ? NEEDED_OF_LENS : { "k_cam_px": "k_cam" }) };
	return Object.entries(needed).flatMap(([path, words]) => ((fields[path] ?? "").trim() ? [] : [words]));
}

/**
 * k_cam at the focus distance that is filled in, of a focal length far below it; null where there is nothing to change.
 *
 * @param {Fields} fields
 * @param {{k_cam_px: number, focus_distance_m: number} | null} held as it is known
 */
export function refocusedKCam(fields, held) {
	const focusM = toMetres(fields.focus_distance_m ?? "");
	if (!held || !focusM || fields.by !== "k_cam" || fields.k_cam_px !== String(held.k_cam_px)) return null;
	if (focusM === held.focus_distance_m) return null;
	return { focusM, kCamPx: Number(((held.k_cam_px * held.focus_distance_m) / focusM).toPrecision(6)) };
}

/** What differs between two cameras, field by field. @param {any} before @param {any} after */
export function differences(before, after) {
	const [from, to] = [fieldsOf(specsOf(before)), fieldsOf(specsOf(after))];
	const paths = [...new Set([...Object.keys(from), ...Object.keys(to)])].filter((path) => path !== "by");
	return paths
		.filter((path) => (from[path] ?? "") !== (to[path] ?? ""))
		.map((path) => ({ path, before: from[path] ?? "", after: to[path] ?? "" }));
}

/**
 * Numbers apart by spaces or semicolons, with points or commas; or by commas, where those can be nothing else.
 *
 * @param {string} text
 * @returns {number[] | null} null where it is not clear which numbers are meant
 */
export function numbersOf(text) {
	const apart = (/** @type {RegExp} */ separator) => {
		const parts = text.split(separator).filter(Boolean);
		return parts.every((part) => NUMBER.test(part)) ? parts.map(decimal) : null;
	};
	const isList = !/,\S/.test(text) || /^[^\s;]*\.[^\s;]*$/.test(text);
	return apart(/[\s;]+/) ?? (isList ? apart(/[\s,]+/) : null);
}

/** @param {string} text */
function toNumber(text) {
	const value = decimal(text);
	return Number.isNaN(value) ? text : value;
}
