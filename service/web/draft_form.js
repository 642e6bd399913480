/** A camera drafted by the service from a photograph's EXIF, to be completed and stored. */

import { getJson, problemOf, storeCamera } from "./api.js";
import { Field } from "./camera_form.js";
import { SENSOR_WIDTH, bodyOf, fieldsOf, missingOf } from "./camera_specs.js";
import { decimal } from "./numbers.js";
import { sending } from "./photograph_files.js";
import { ProblemBox, Warnings, useProblem } from "./problem_box.js";
import { html, useEffect, useState } from "./vendor/preact.js";

const NUMBERS = [
	["focus_distance_m", "Focus distance (m)"],
	["lens/focal_length_mm", "Real focal length (mm)"],
	["lens/f_number", "f-number"],
	["lens/pixel_pitch_um", "Pixel pitch (µm)"],
	["lens/sensor_width_px", "Sensor width (px)", SENSOR_WIDTH],
];

/** @param {DraftFormProps} props */
export function DraftForm({ file, onStored, onFailed }) {
	const [draft, setDraft] = useState(/** @type {any} */ (null));
	const [fields, setFields] = useState(/** @type {Fields} */ ({}));
	const [problem, setProblem, guard] = useProblem();
	const [isStoring, setIsStoring] = useState(false);
	const [attempt, setAttempt] = useState(0);

	useEffect(() => {
		const abort = new AbortController();
		setProblem(null);
		getJson("cameras/from-photo", { ...sending(file), signal: abort.signal })
			.then((drafted) => {
				setDraft(drafted);
				setFields(fieldsOf(drafted));
			})
			.catch((error) => {
				if (abort.signal.aborted) return;
				setProblem(problemOf(error));
				onFailed(error);
			});
		return () => abort.abort();
	}, [file, attempt]);

	/** @param {SubmitEvent} event */
	function store(event) {
		event.preventDefault();
		if (isStoring) return;
		setIsStoring(true);
		setProblem(null);
		guard(async () => onStored(await storeCamera(bodyOf(fields), null))).finally(() => setIsStoring(false));
	}

	if (draft === null) {
		return problem ? html`<${ProblemBox} problem=${problem} onRetry=${() => setAttempt(attempt + 1)} />` : html`<p class="hint">Reading the photograph's EXIF…</p>`;
	}
	const missing = missingOf(fields);
	const faults = NUMBERS.filter(([path]) => Number.isNaN(decimal(fields[path] ?? ""))).map(([path]) => ({
		pointer: `#/${path}`,
		detail: "This is no number.",
	}));
	const field = (/** @type {string} */ path, /** @type {string} */ label, hint = "", kind = "decimal") =>
		html`<${Field}
			...${{ path, label, hint, kind, form: "draft", value: fields[path] ?? "" }}
			faults=${[...faults, ...(problem?.errors ?? [])]}
			onChange=${(changed) => {
				setFields((before) => ({ ...before, ...changed }));
				setProblem(null);
			}}
		/>`;
	return html`<form class="card stack" onSubmit=${store} aria-label="A camera from this photograph">
		<h3>A camera from this photograph</h3>
		<p class="hint">
			${draft.image_width_px} × ${draft.image_height_px} px${draft.description && `, ${draft.description}`}. Choose a stored
			camera above, or complete this one. The real focal length, never the 35-mm equivalent.
		</p>
		<div class="pair">
			${field("name", "Name", "", "text")} ${NUMBERS.map(([path, label, hint]) => field(path, label, hint))}
		</div>
		<${Warnings} texts=${draft.warnings} />
		<${ProblemBox} problem=${problem} />
		<div class="row">
			<button class="primary" disabled=${missing.length + faults.length > 0}>
				Store the camera and read the depth
			</button>
			${missing.length > 0 && html`<span class="hint">Fill in ${missing.join(", ")} first.</span>`}
		</div>
	</form>`;
}
