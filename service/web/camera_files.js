/** Cameras as files: all or one out, and back in after it is shown what that would do. */

import { Problem, everyCamera, problemOf, sendJson, storeCamera } from "./api.js";
import { differences, specsOf } from "./camera_specs.js";
import { counted } from "./numbers.js";
import { save } from "./save.js";
import { Table } from "./table.js";
import { html, useEffect, useRef, useState } from "./vendor/preact.js";

/** @param {any[]} cameras @param {string} name of the file */
export function exportCameras(cameras, name) {
	const text = `${JSON.stringify({ cameras: cameras.map(specsOf) }, null, 2)}\n`;
	save(new Blob([text], { type: "application/json" }), `${name}.json`);
}

/** @param {{file: File, onClose: (stored: number) => void}} props */
export function ImportDialog({ file, onClose }) {
	const dialog = useRef(/** @type {?HTMLDialogElement} */ (null));
	const [steps, setSteps] = useState(/** @type {Step[] | null} */ (null));
	const [fault, setFault] = useState("");
	const [isBusy, setIsBusy] = useState(false);
	const those = (/** @type {Step["does"][]} */ ...what) => (steps ?? []).filter(({ does }) => what.includes(does));
	const wanted = those("create", "update");
	const stored = those("done").length;

	useEffect(() => {
		dialog.current?.showModal();
		planOf(file).then(setSteps, (error) => setFault(`${error.title ?? ""} ${error.message}`));
	}, []);

	async function carryOut() {
		setIsBusy(true);
		for (const step of wanted) {
			if (!dialog.current?.open) return;
			const done = await stepDone(step);
			setSteps((before) => (before ?? []).map((one) => (one === step ? done : one)));
		}
		setIsBusy(false);
	}

	return html`
		<dialog ref=${dialog} class="wide" aria-labelledby="import-title" onClose=${() => onClose(stored)}>
			<div class="stack">
				<h2 id="import-title">Import cameras</h2>
				${fault && html`<p class="fault" role="alert">${fault}</p>`}
				${steps &&
				html`<${Table} label="What the import does" head=${["Camera", "What happens"]}>
					${steps.map(
						({ name, does, words }) => html`<tr>
							<th scope="row">${name}</th>
							<td><span class=${`badge ${TONES[does]}`}>${LABELS[does]}</span> ${words}</td>
						</tr>`,
					)}
				<//>`}
				<div class="row">
					${wanted.length > 0 &&
					html`<button class="primary" disabled=${isBusy} onClick=${carryOut}>
						Import ${counted(wanted.length, "camera")}
					</button>`}
					<button onClick=${() => dialog.current?.close()}>${stored > 0 ? "Close" : "Cancel"}</button>
					<span role="status">
						${steps
							? wanted.length === 0 && `${counted(stored, "camera is", "cameras are")} stored, ${those("refuse").length} refused`
							: !fault && `Reading ${file.name} ...`}
					</span>
				</div>
			</div>
		</dialog>
	`;
}

const LABELS = { create: "new", update: "changes", nothing: "the same", refuse: "refused", done: "stored" };
const TONES = { create: "good", update: "warn", nothing: "", refuse: "bad", done: "good" };

/** @param {File} file @returns {Promise<Step[]>} */
async function planOf(file) {
	/** @type {any} */
	let content;
	try {
		content = JSON.parse(await file.text());
	} catch {
		throw new Error(`${file.name} is no JSON: export one here to see what it looks like.`);
	}
	const listed = Array.isArray(content) ? content : (content?.cameras ?? content?.items ?? [content]);
	if (!Array.isArray(listed) || listed.length === 0) throw new Error(`There is no camera in ${file.name}.`);
	const cameras = await everyCamera();
	const names = listed.map((one) => one?.name);
	const steps = [];
	for (const [place, one] of listed.entries()) {
		const isTwice = names.indexOf(one?.name) < place;
		steps.push(isTwice ? refused(one, "its name stands in the file twice") : await planned(one, cameras));
	}
	return steps;
}

/** @param {any} given @param {any[]} cameras that are there @returns {Promise<Step>} */
async function planned(given, cameras) {
	if (typeof given !== "object" || given === null || typeof given.name !== "string") {
		return refused(given, "it is no camera with a name");
	}
	// what the API answers has more than it takes
	const camera = "revision" in given ? specsOf(given) : given;
	try {
		await sendJson("cameras/preview", camera);
	} catch (error) {
		if (error instanceof Problem && error.status === 422) return refused(given, error.detail);
		throw error;
	}
	const { name } = camera;
	const here = cameras.find((one) => one.name === name);
	if (!here) return { camera, name, does: "create", words: "", revision: null };
	const changed = differences(here, camera).map(({ path }) => path.replace("/", " "));
	if (changed.length === 0) return { camera, name, does: "nothing", words: "", revision: here.revision };
	const words = `${changed.join(", ")}: revision ${here.revision} becomes ${here.revision + 1}`;
	return { camera, name, does: "update", words, revision: here.revision };
}

/** @param {any} given @param {string} words @returns {Step} */
function refused(given, words) {
	return { camera: given, name: String(given?.name ?? "?"), does: "refuse", words, revision: null };
}

/** @param {Step} step @returns {Promise<Step>} */
async function stepDone(step) {
	try {
		const { revision } = await storeCamera(step.camera, step.revision);
		return { ...step, does: "done", words: `as revision ${revision}` };
	} catch (error) {
		const { title, detail } = problemOf(error);
		return { ...step, does: "refuse", words: `${title} ${detail}` };
	}
}
