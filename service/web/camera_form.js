/** A camera to fill in, new or for its next revision, with what its numbers come to while they are typed. */

import { Problem, getJson, problemOf, sendJson, storeCamera } from "./api.js";
import { CameraCurve } from "./camera_curve.js";
import {
	BLANK,
	SENSOR_WIDTH,
	bodyOf,
	differences,
	fieldsOf,
	filledIn,
	missingOf,
	numbersOf,
	refocusedKCam,
} from "./camera_specs.js";
import { short } from "./numbers.js";
import { PHOTOGRAPHS, sending } from "./photograph_files.js";
import { ProblemBox, Warnings, useProblem } from "./problem_box.js";
import { Table } from "./table.js";
import { TextField } from "./text_field.js";
import { html, useEffect, useRef, useState } from "./vendor/preact.js";

const WAIT_MS = 250;

/** Bring the reader to a heading, which may be out of sight. @param {?HTMLElement} heading */
export function arriveAt(heading) {
	heading?.focus({ preventScroll: true });
	const top = heading?.getBoundingClientRect().top ?? 0;
	if (top < 0 || top > innerHeight / 2) heading?.scrollIntoView();
}

/** @param {CameraFormProps} props */
export function CameraForm({ editing, onSaved, onTyped, onCancel }) {
	const [base, setBase] = useState(editing);
	const [fields, setFields] = useState(/** @type {Fields} */ (editing ? fieldsOf(editing) : BLANK));
	const [held, setHeld] = useState(/** @type {{k_cam_px: number, focus_distance_m: number} | null} */ (editing));
	const [problem, setProblem, guard] = useProblem();
	const [told, setTold] = useState(/** @type {string[]} */ ([]));
	const [theirs, setTheirs] = useState(/** @type {?any} */ (null));
	const [isSaving, setIsSaving] = useState(false);
	const { preview, faults: previewFaults } = usePreview(fields);
	const title = useRef(/** @type {?HTMLHeadingElement} */ (null));
	const trouble = useRef(/** @type {?HTMLElement} */ (null));
	const faults = [...unclear(fields), ...previewFaults, ...(problem?.errors ?? [])];
	const missing = missingOf(fields);
	const refocused = refocusedKCam(fields, held);

	useEffect(() => arriveAt(title.current), []);
	useEffect(() => arriveAt(problem || theirs ? trouble.current : null), [problem, theirs]);

	/** @param {Fields} changed */
	function change(changed) {
		setFields((before) => ({ ...before, ...changed }));
		setProblem(null);
		onTyped();
	}

	/** @param {?number} revision that is replaced; null for a new camera */
	async function save(revision) {
		setIsSaving(true);
		setProblem(null);
		try {
			const camera = await storeCamera(bodyOf(fields), revision);
			onSaved(`Camera ${camera.name} is stored as revision ${camera.revision}.`, camera);
		} catch (error) {
			if (!(error instanceof Problem)) throw error;
			if (error.status === 412) await showTheirs();
			else setProblem(error);
			if (error.status === 404) setBase(null); // deleted meanwhile: what is typed can be stored anew
		} finally {
			setIsSaving(false);
		}
	}

	const showTheirs = () => guard(async () => setTheirs(await getJson(`cameras/${encodeURIComponent(base.name)}`)));

	/** @param {Event} event */
	async function fillFromPhotograph(event) {
		const input = /** @type {HTMLInputElement} */ (event.target);
		const file = input.files?.[0];
		if (!file) return;
		await guard(async () => {
			const draft = await getJson("cameras/from-photo", sending(file));
			setTold(draft.warnings);
			setFields((before) => filledIn(before, draft));
			onTyped();
			setProblem(null);
		});
		input.value = "";
	}

	const field = (/** @type {string} */ path, /** @type {string} */ label, /** @type {any} */ more = {}) =>
		html`<${Field} ...${{ path, label, ...more }} value=${fields[path] ?? ""} faults=${faults} onChange=${change} />`;

	return html`
		<form
			class="card"
			aria-labelledby="camera-form-title"
			onSubmit=${(event) => {
				event.preventDefault();
				save(base?.revision ?? null);
			}}
		>
			<div class="row ends">
				<h3 id="camera-form-title" tabindex="-1" ref=${title}>${base ? `Edit ${base.name}` : "New camera"}</h3>
				${base && html`<span class="badge">revision ${base.revision}</span>`}
			</div>
			<div ref=${trouble} tabindex="-1" hidden=${!problem && !theirs}>
				${theirs &&
				html`<${Conflict}
					...${{ base, theirs, fields }}
					onMine=${() => {
						setTheirs(null);
						setBase(theirs);
						save(theirs.revision);
					}}
					onTheirs=${() => {
						setTheirs(null);
						setBase(theirs);
						setFields(fieldsOf(theirs));
						setHeld(theirs);
					}}
				/>`}
				<${ProblemBox} problem=${problem} />
			</div>
			<label class="field">
				Fill in from a photograph it took
				<input type="file" accept=${PHOTOGRAPHS} onChange=${fillFromPhotograph} />
				<span class="hint">Its EXIF tells lens and sensor. The photograph is not kept.</span>
			</label>
			${told.length > 0 && html`<div role="status"><${Warnings} texts=${told} /></div>`}
			<div class="pair">
				${field("name", "Name", { disabled: base !== null, kind: "text", hint: "letters, digits, dots, dashes" })}
				${field("focus_distance_m", "Focus distance (m)", { hint: "from the lens to what is sharp" })}
				${field("image_width_px", "Image width (px)", { hint: "of the photographs you will send" })}
				${field("image_height_px", "Image height (px)")}
			</div>
			<fieldset class="row">
				<legend>Its blur is known by</legend>
				${[
					["lens", "lens specs"],
					["k_cam", "k_cam"],
				].map(
					([value, words]) => html`<label class="choice">
						<input type="radio" name="by" value=${value} checked=${fields.by === value} onChange=${() => change({ by: value })} />
						${words}
					</label>`,
				)}
			</fieldset>
			${fields.by === "lens"
				? html`<div class="pair">
						${field("lens/focal_length_mm", "Focal length (mm)", { hint: "the real one, never the 35-mm equivalent" })}
						${field("lens/f_number", "f-number")}
						${field("lens/pixel_pitch_um", "Pixel pitch (µm)", { hint: "of one sensor pixel" })}
						${field("lens/sensor_width_px", "Sensor width (px)", { hint: SENSOR_WIDTH })}
					</div>`
				: html`<div class="pair">
						${field("k_cam_px", "k_cam (px)", { hint: "blur per unit of relative defocus, at the image width" })}
						${field("f_number", "f-number", { hint: "of the photographs that this k_cam is of, if you know it" })}
					</div>`}
			${held &&
			refocused &&
			html`<p class="notice" role="status">
				This k_cam holds at a focus distance of ${short(held.focus_distance_m, 4)} m; at ${short(refocused.focusM, 4)} m it is
				${" "}${short(refocused.kCamPx, 4)}.${" "}
				<button
					type="button"
					onClick=${() => {
						setHeld({ k_cam_px: refocused.kCamPx, focus_distance_m: refocused.focusM });
						change({ k_cam_px: String(refocused.kCamPx) });
					}}
				>
					Use ${short(refocused.kCamPx, 4)}
				</button>
			</p>`}
			<details>
				<summary>More: gamma, intrinsics, description</summary>
				<div class="pair">
					${field("gamma_px", "gamma (px)", { hint: "blur of a point in perfect focus" })}
					${fields.by === "lens" && field("lens/k_r", "k_r", { hint: "circle of confusion over its deviation; a disc has 4" })}
					${field("intrinsics/fx_px", "fx (px)")} ${field("intrinsics/fy_px", "fy (px)")}
					${field("intrinsics/cx_px", "cx (px)")} ${field("intrinsics/cy_px", "cy (px)")}
					${field("intrinsics/distortion", "Distortion", { kind: "text", hint: "0, 4, 5, 8, 12 or 14 numbers in OpenCV's order, not its fisheye's" })}
					${field("description", "Description", { kind: "text" })}
				</div>
			</details>
			${base?.source === "calibration" &&
			html`<p class="hint">Saved by hand it counts as given; what was calibrated stays as revision ${base.revision}.</p>`}
			<div class="row">
				<button class="primary" disabled=${isSaving}>${base ? "Save as a new revision" : "Create camera"}</button>
				<button type="button" onClick=${onCancel}>Cancel</button>
			</div>
			<section class="stack live" aria-label="What these numbers come to" aria-live="polite">
				${preview
					? html`<${CameraCurve} camera=${preview} points=${preview.points} />`
					: html`<p class="hint">
							${missing.length > 0
								? `Fill in ${missing.join(", ")} to see what the camera can measure.`
								: (faults[0]?.detail ?? "Working it out ...")}
						</p>`}
			</section>
		</form>
	`;
}

/** @param {FieldProps} props */
export function Field({ path, label, value, form = "camera", kind = "decimal", hint, disabled = false, faults, onChange }) {
	const fault = faults.find(({ pointer }) => pointer === `#/${path}` || pointer.startsWith(`#/${path}/`))?.detail;
	return html`<${TextField}
		...${{ id: `${form}-${path.replace("/", "-")}`, label, value, kind, fault, hint, disabled, role: null }}
		onInput=${(text) => onChange({ [path]: text })}
	/>`;
}

/** @param {Fields} fields @returns {FieldProblem[]} */
function unclear({ "intrinsics/distortion": text = "" }) {
	const detail = "It is not clear which commas are decimal: put spaces or semicolons between the numbers.";
	return numbersOf(text) || !text.includes(",") ? [] : [{ pointer: "#/intrinsics/distortion", detail }];
}

/** What somebody else stored while this was edited, and whose is to stay. @param {ConflictProps} props */
function Conflict({ base, theirs, fields, onMine, onTheirs }) {
	const changed = differences(base, theirs);
	return html`
		<div class="notice" role="alert">
			<p>
				<strong>${base.name} was changed while you edited it.</strong> You opened revision ${base.revision}; now it is at
				revision ${theirs.revision}. Nothing of yours is stored yet.
			</p>
			${changed.length > 0
				? html`<${Table} label="What changed" head=${["Field", "You opened", "Now stored", "Yours"]}>
						${changed.map(
							({ path, before, after }) => html`<tr>
								<th scope="row">${path.replace("/", " ")}</th>
								<td>${before || "–"}</td>
								<td>${after || "–"}</td>
								<td>${fields[path] || "–"}</td>
							</tr>`,
						)}
					<//>`
				: html`<p>Its numbers are the same as those you opened.</p>`}
			<div class="row">
				<button type="button" onClick=${onMine}>Store mine as revision ${theirs.revision + 1}</button>
				<button type="button" onClick=${onTheirs}>Take what is stored</button>
			</div>
		</div>
	`;
}

/** The service's answer to the fields, a moment after the last change. @param {Fields} fields */
function usePreview(fields) {
	const [seen, setSeen] = useState({ preview: /** @type {any} */ (null), faults: /** @type {any[]} */ ([]) });
	const { name: _, description: __, ...numbers } = bodyOf(fields);
	const body = missingOf(fields).length > 0 ? null : JSON.stringify(numbers);
	useEffect(() => {
		if (body === null) {
			setSeen({ preview: null, faults: [] });
			return undefined;
		}
		const stop = new AbortController();
		const timer = setTimeout(async () => {
			try {
				const preview = await sendJson("cameras/preview", JSON.parse(body), { signal: stop.signal, asks: false });
				setSeen({ preview, faults: [] });
			} catch (error) {
				if (stop.signal.aborted) return;
				const { errors, detail } = problemOf(error);
				setSeen({ preview: null, faults: errors.length ? errors : [{ pointer: "", detail }] });
			}
		}, WAIT_MS);
		return () => {
			clearTimeout(timer);
			stop.abort();
		};
	}, [body]);
	return seen;
}
