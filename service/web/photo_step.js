/** The second step: photographs of the sheet, each looked at as it comes, and what the set lacks yet. */

import { Problem, getJson, problemOf } from "./api.js";
import { Chart } from "./chart.js";
import { DropPlace, FileButton } from "./file_choice.js";
import { WANTED, adviceFor, coverageOf, focusOf } from "./guidance.js";
import { counted, measure } from "./numbers.js";
import { PHOTOGRAPHS, readShown, sending, upright } from "./photograph_files.js";
import { html, useEffect, useRef, useState } from "./vendor/preact.js";

const THUMB_PX = 320;
const EXPOSURES = { good: "good", over: "too bright", under: "too dark" };

/** @type {{role: Role, title: string, words: string}[]} */
const ROLES = [
	{
		role: "defocused",
		title: "Focus locked",
		words: "All with the same focus, nearer and farther than what is sharp; the sharp ones among them too.",
	},
	{
		role: "focused",
		title: "Focused on the sheet",
		words: "Only if you took pairs: the sharp partner of each blurred photograph, in the same order.",
	},
];

let lastId = 0;

/** @param {Iterable<File>} files @param {Role} role @returns {Photo[]} */
function photosOf(files, role) {
	return [...files].map((file) => ({ id: (lastId += 1), file, role, asked: "", look: null, problem: null }));
}

/**
 * Looks at one photograph after the other, whenever there is one that was not.
 *
 * @param {Photo[]} photos
 * @param {(change: (before: Photo[]) => Photo[]) => void} setPhotos
 * @param {string} query the pattern and camera
 */
export function useLooks(photos, setPhotos, query) {
	const next = photos.find(({ asked }) => asked !== query);
	const asks = !photos.some(({ problem }) => problem?.status === 401); // one asks for a key, not all
	useEffect(() => {
		if (!next || !query) return undefined;
		const stop = new AbortController();
		const tell = (/** @type {any} */ look, /** @type {?Problem} */ problem = null) =>
			setPhotos((before) => before.map((one) => (one.id === next.id ? { ...one, look, problem, asked: query } : one)));
		lookAt(next.file, query, asks, stop.signal).then(tell, (error) => stop.signal.aborted || tell(null, problemOf(error)));
		return () => stop.abort();
	}, [next?.id, query]);
}

/** @param {File} file @param {string} query @param {boolean} asks @param {AbortSignal} signal */
async function lookAt(file, query, asks, signal) {
	for (;;) {
		try {
			return await getJson(`calibrate/look?${query}`, { ...sending(file), asks, signal });
		} catch (error) {
			if (!(error instanceof Problem && error.retryAfterS)) throw error;
			const waitMs = error.retryAfterS * 1000;
			await new Promise((resolve) => setTimeout(resolve, waitMs));
			signal.throwIfAborted();
		}
	}
}

/** @param {PhotographsProps} props */
export function Photographs({ photos, query, focus, onChange, announce }) {
	const waiting = photos.filter(({ asked }) => asked !== query).length;
	const seen = photos.filter(({ look }) => look?.found).map(seenOf);
	const next = adviceFor(seen, focus);
	const failed = photos.filter(({ problem }) => problem?.isPassing).length;
	const found = `The sheet is found in ${seen.length} of ${counted(photos.length, "photograph")}${failed ? `, ${failed} not looked at` : ""}`;
	const [known, setKnown] = useState("");
	useEffect(() => {
		if (photos.length > 0 && waiting === 0) announce(`${found}. ${next}`);
	}, [waiting === 0, photos.length]);

	/** @param {File[]} files @param {Role} role */
	function add(files, role) {
		const isThere = (/** @type {File} */ { name, size, lastModified: at }) =>
			photos.some(({ role: its, file }) => its === role && file.name === name && file.size === size && file.lastModified === at);
		const others = files.filter((file) => !isThere(file));
		const skipped = files.length - others.length;
		const words = skipped ? `${counted(skipped, "photograph was", "photographs were")} there already.` : "";
		setKnown(words);
		if (words) announce(words);
		onChange((before) => [...before, ...photosOf(others, role)]);
	}

	return html`
		<div class="columns">
			${ROLES.map(({ role, title, words }) => {
				const onFiles = (/** @type {File[]} */ files) => add(files, role);
				const of = { multiple: true, accept: PHOTOGRAPHS, "data-role": role, "aria-label": title };
				return html`<${DropPlace} key=${role} onFiles=${onFiles}>
					<h3>${title}</h3>
					<p class="hint">${words}</p>
					<${FileButton} aria-label=${`Choose photographs: ${title}`} ...${{ of, onFiles }}>Choose photographs<//>
					<span class="hint">or drop them here</span>
				<//>`;
			})}
		</div>
		<div class="notice next">
			<p>
				<strong>${next}</strong>
				${photos.length > 0 && html` <span>${`${found}; ${WANTED} to 12 make a good set.`}</span>`}
			</p>
			${known && html`<p class="hint">${known}</p>`}
			${waiting > 0 && html`<p class="hint">Looking at ${counted(waiting, "photograph")} ...</p>`}
		</div>
		${photos.length > 0 &&
		html`<ul class="photos" aria-label="Photographs">
			${photos.map(
				(photo) => html`<${PhotoCard}
					key=${photo.id}
					photo=${photo}
					isLooking=${photo.asked !== query}
					hasPartner=${hasPartner(photo, photos)}
					onRole=${(role) => onChange((before) => before.map((one) => (one.id === photo.id ? { ...one, role } : one)))}
					onAgain=${() => onChange((before) => before.map((one) => (one.id === photo.id || one.problem?.isPassing ? { ...one, asked: "", problem: null } : one)))}
					onRemove=${() => onChange((before) => before.filter(({ id }) => id !== photo.id))}
				/>`,
			)}
		</ul>`}
		${seen.length > 0 &&
		html`<div class="columns">
			<${Coverage} seen=${seen} />
			<${Distances} seen=${seen} focus=${focusOf(seen, focus)} />
		</div>`}
	`;
}

/** @param {Photo} photo that is found @returns {Seen} */
function seenOf({ role, look }) {
	const { width_px: width, height_px: height, orientation, circles, blur_px: blur, distance_m: distance, tilt_deg: tilt } = look;
	return { role, width, height, orientation, circles, blur, distance, tilt };
}

/** Whether a defocused photograph has a focused one to tell where its circles are. @param {Photo} photo @param {Photo[]} photos */
function hasPartner(photo, photos) {
	const place = photos.filter(({ role }) => role === "defocused").indexOf(photo);
	return place >= 0 && Boolean(photos.filter(({ role }) => role === "focused")[place]?.look?.found);
}

/** @param {PhotoCardProps} props */
function PhotoCard({ photo, isLooking, hasPartner: partner, onRole, onAgain, onRemove }) {
	const { file, look, problem, role } = photo;
	const [tone, words] = statusOf(photo, isLooking);
	return html`
		<li class="card tight">
			<${Thumb} file=${file} look=${look} />
			<div class="row ends">
				<span class="file" title=${file.name}>${file.name}</span>
				<span class=${`badge ${tone}`}>${words}</span>
			</div>
			${problem &&
			html`<p class="fault">${problem.title} ${problem.detail}</p>
				${!isLooking && problem.isPassing && html`<button onClick=${onAgain}>Look again</button>`}`}
			${look?.found &&
			html`<dl class="facts">
				<dt>Blur</dt><dd>${measure(look.blur_px, " px")}</dd>
				<dt>Distance</dt><dd>${measure(look.distance_m, " m", 4)}</dd>
				<dt>Tilt</dt><dd>${measure(look.tilt_deg, "°", 2)}</dd>
				<dt>Exposure</dt>
				<dd class=${look.exposure === "good" ? "" : "fault"}>${EXPOSURES[/** @type {keyof typeof EXPOSURES} */ (look.exposure)]}</dd>
			</dl>`}
			${look?.warnings.map((/** @type {string} */ told) => html`<p class="hint">${told}</p>`)}
			${look && !look.found && partner && html`<p class="hint">Its circles are looked for where its sharp partner has them.</p>`}
			<div class="row ends">
				<select
					aria-label=${`How ${file.name} was focused`}
					value=${role}
					onChange=${(event) => onRole(event.target.value)}
				>
					${ROLES.map((one) => html`<option value=${one.role}>${one.title}</option>`)}
				</select>
				<button class="quiet" aria-label=${`Remove ${file.name}`} onClick=${onRemove}>Remove</button>
			</div>
		</li>
	`;
}

/** @param {Photo} photo @param {boolean} isLooking */
function statusOf({ look, problem }, isLooking) {
	if (isLooking) return ["", "looking ..."];
	if (problem) return ["bad", [413, 415, 422].includes(problem.status) ? "not readable" : "not looked at"];
	if (!look?.found) return ["bad", "no grid"];
	if (look.measured === 0) return ["bad", "not measured"];
	return look.warnings.length > 0 || look.exposure !== "good" ? ["warn", "found"] : ["good", "found"];
}

// one after the other: forty opened at a time may be more than a phone has
let before = Promise.resolve();

/** The photograph upright and small, with the circles over it. @param {{file: File, look: any | null}} props */
function Thumb({ file, look }) {
	const canvas = useRef(/** @type {?HTMLCanvasElement} */ (null));
	const [bitmap, setBitmap] = useState(/** @type {?ImageBitmap} */ (null));
	useEffect(() => {
		let made = /** @type {?ImageBitmap} */ (null);
		const stop = new AbortController();
		const { signal } = stop;
		const small = (/** @type {Blob} */ shown) =>
			createImageBitmap(shown, { resizeWidth: THUMB_PX, resizeQuality: "medium" }).catch(() => null);
		before = before.then(async () => {
			if (signal.aborted) return;
			made = await readShown(file, THUMB_PX, small, signal);
			if (signal.aborted) made?.close();
			else setBitmap(made);
		});
		return () => {
			stop.abort();
			made?.close();
		};
	}, [file]);
	useEffect(() => {
		if (canvas.current) draw(canvas.current, bitmap, look);
	}, [bitmap, look]);
	const words = look?.found ? `${file.name} with ${look.circles.length} circles found` : file.name;
	return html`<canvas ref=${canvas} role="img" aria-label=${words}></canvas>`;
}

/** @param {HTMLCanvasElement} canvas @param {?ImageBitmap} bitmap @param {?any} look */
function draw(canvas, bitmap, look) {
	const isTurned = look !== null && look.orientation > 4;
	const [width, height] = look ? (isTurned ? [look.height_px, look.width_px] : [look.width_px, look.height_px]) : [4, 3];
	canvas.width = THUMB_PX;
	canvas.height = bitmap ? bitmap.height : Math.round((THUMB_PX * height) / width);
	const pen = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
	if (bitmap) pen.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
	if (!look?.found) return;
	const scale = THUMB_PX / width;
	pen.lineWidth = 2;
	pen.strokeStyle = "#ffd166";
	for (const { u_px: u, v_px: v, radius_px: radius } of look.circles) {
		const [x, y] = upright(u + 0.5, v + 0.5, look.orientation, look.width_px, look.height_px);
		pen.beginPath();
		pen.arc(x * scale, y * scale, Math.max(radius * scale, 2), 0, 2 * Math.PI);
		pen.stroke();
	}
}

/** @param {{seen: Seen[]}} props */
function Coverage({ seen }) {
	const cells = coverageOf(seen);
	const all = cells.flat();
	const most = Math.max(...all);
	const words = `Circles were in ${all.filter(Boolean).length} of ${all.length} parts of the frame`;
	return html`
		<figure class="card">
			<figcaption><h3>Coverage of the frame</h3></figcaption>
			<svg class="coverage" viewBox=${`0 0 ${cells[0].length * 10} ${cells.length * 10}`} role="img" aria-label=${words}>
				${cells.map((row, y) =>
					row.map(
						(count, x) => html`<rect
							x=${x * 10 + 0.25}
							y=${y * 10 + 0.25}
							width="9.5"
							height="9.5"
							class=${count === 0 ? "empty" : ""}
							fill-opacity=${count === 0 ? 1 : 0.25 + (0.75 * count) / most}
						/>`,
					),
				)}
			</svg>
			<p class="hint">${words}. A lens is not alike everywhere: let the sheet reach the corners too.</p>
		</figure>
	`;
}

/** @param {{seen: Seen[], focus: number | null}} props */
function Distances({ seen, focus }) {
	const points = seen.flatMap(({ distance: x, blur: y }) => (x === null || y === null ? [] : [{ x, y }]));
	return html`
		<div class="card">
			<h3>Coverage over distance</h3>
			${points.length > 0
				? html`<${Chart}
						title="Blur of each photograph"
						x=${{ label: "distance", unit: "m", isLog: true, from: Math.min(...points.map(({ x }) => x), focus ?? Infinity) * 0.8, to: Math.max(...points.map(({ x }) => x), focus ?? 0) * 1.25 }}
						y=${{ label: "blur", unit: "px", from: 0 }}
						marks=${focus ? [{ x: focus, label: "sharpest" }] : []}
						series=${[{ name: "", kind: "dots", tone: "one", points }]}
					/>`
				: html`<p class="hint">
						Neither a camera nor the photographs' EXIF tells the focal length, so distances are known only after the calibration.
					</p>`}
		</div>
	`;
}
