/** A camera drafted by the service from a photograph's EXIF, to be completed and stored. */

import { Problem, sendJson, upload } from "./api.js";
import { ProblemBox } from "./problem_box.js";
import { html, useEffect, useState } from "./vendor/preact.js";

const NUMBERS = [
	["focus_distance_m", "Focus distance, m"],
	["focal_length_mm", "Real focal length, mm"],
	["f_number", "f-number"],
	["pixel_pitch_um", "Pixel pitch, µm"],
];

/** @param {{file: File, mediaType: string, onStored: (name: string) => Promise<void>}} props */
export function DraftForm({ file, mediaType, onStored }) {
	const [draft, setDraft] = useState(/** @type {any} */ (null));
	const [problem, setProblem] = useState(/** @type {Problem | null} */ (null));
	const [isStoring, setIsStoring] = useState(false);

	useEffect(() => {
		const abort = new AbortController();
		const headers = { "Content-Type": mediaType };
		upload("cameras/from-photo", { body: file, headers, signal: abort.signal, responseType: "json" })
			.then(({ body }) => setDraft(body))
			.catch(show);
		return () => abort.abort();
	}, [file]);

	/** @param {unknown} error */
	function show(error) {
		if (error instanceof Problem) setProblem(error);
		else if (!(error instanceof DOMException)) throw error;
	}

	/** @param {SubmitEvent & {currentTarget: HTMLFormElement}} event */
	async function store(event) {
		event.preventDefault();
		const given = new FormData(event.currentTarget);
		const number = (/** @type {string} */ name) => Number(given.get(name));
		const { warnings, name, ...rest } = draft;
		const camera = {
			...rest,
			name: given.get("name"),
			focus_distance_m: number("focus_distance_m"),
			lens: { ...draft.lens },
		};
		for (const [field] of NUMBERS.slice(1)) camera.lens[field] = number(field);
		setIsStoring(true);
		setProblem(null);
		try {
			await onStored((await sendJson("cameras", camera)).name);
		} catch (error) {
			show(error);
		} finally {
			setIsStoring(false);
		}
	}

	if (draft === null) {
		return problem ? html`<${ProblemBox} problem=${problem} />` : html`<p class="hint">Reading the photograph's EXIF…</p>`;
	}
	const known = { ...draft, ...draft.lens };
	return html`<form class="card stack" onSubmit=${store} aria-label="A camera from this photograph">
		<h3>A camera from this photograph</h3>
		<p class="hint">
			${draft.image_width_px} × ${draft.image_height_px} px${draft.description && `, ${draft.description}`}. Choose a stored
			camera above, or complete this one. The real focal length, never the 35-mm equivalent.
		</p>
		<div class="depth-draft">
			<label class="field">Name <input name="name" required maxlength="64" defaultValue=${draft.name} /></label>
			${NUMBERS.map(
				([name, title]) => html`<label class="field" key=${name}
					>${title}
					<input name=${name} type="number" inputmode="decimal" step="any" min="0" required defaultValue=${known[name] ?? ""} />
				</label>`,
			)}
		</div>
		${draft.warnings.length > 0 &&
		html`<ul class="notice depth-warnings">
			${draft.warnings.map((/** @type {string} */ text) => html`<li key=${text}>${text}</li>`)}
		</ul>`}
		<${ProblemBox} problem=${problem} />
		<div class="row">
			<button type="submit" class="primary" disabled=${isStoring}>Store the camera and read the depth</button>
		</div>
	</form>`;
}
