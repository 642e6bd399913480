/** The cameras: listed, read with their curve and revisions, made, changed, deleted, exported and imported. */

import { getJson, request } from "./api.js";
import { CameraCurve } from "./camera_curve.js";
import { ImportDialog, exportCameras } from "./camera_files.js";
import { CameraForm, arriveAt } from "./camera_form.js";
import { differences, intrinsicsIn } from "./camera_specs.js";
import { FileButton } from "./file_choice.js";
import { counted, short, when } from "./numbers.js";
import { ProblemBox, useProblem } from "./problem_box.js";
import { html, useEffect, useRef, useState } from "./vendor/preact.js";

const A_PAGE = 20;
/** @type {Record<string, string>} */
const SOURCES = { given: "given", lens: "from lens specs", calibration: "calibrated" };

/** Ask before the page goes. @param {Event} event */
const stay = (event) => event.preventDefault();

/** @param {ViewProps} props */
export function CamerasView({ shown, cameras, lacksCameras, camera, reloadCameras, go, announce }) {
	const [open, setOpen] = useState(/** @type {Open} */ ({ kind: "none" }));
	const [file, setFile] = useState(/** @type {?File} */ (null));
	const [filter, setFilter] = useState("");
	const [most, setMost] = useState(A_PAGE);
	const found = (cameras ?? []).filter(({ name }) => name.toLowerCase().includes(filter.toLowerCase()));
	const read = open.kind === "read" ? cameras?.find(({ name }) => name === open.name) : null;
	const edited = open.kind === "edit" ? open.camera : null;

	const isTyped = useRef(false);

	/** @param {boolean} is */
	function setTyped(is) {
		isTyped.current = is;
		(is ? addEventListener : removeEventListener)("beforeunload", stay);
	}

	useEffect(() => {
		const name = open.kind === "read" ? open.name : (edited?.name ?? null);
		if (!shown || name === camera) return;
		if (mayLeave()) show(camera);
		else go("cameras", { camera: name, replaces: true });
	}, [shown, camera]);

	/** Whether a form may go, with what was typed into it. */
	const mayLeave = () => !isTyped.current || confirm("Throw away what you have typed?");

	/** @param {Open} next */
	function turnTo(next) {
		setTyped(false);
		setOpen(next);
	}

	/** @param {?string} name */
	function show(name) {
		turnTo(name ? { kind: "read", name } : { kind: "none" });
		go("cameras", { camera: name, replaces: true });
	}

	function begin() {
		if (open.kind === "new" || !mayLeave()) return;
		turnTo({ kind: "new" });
		go("cameras");
	}

	/** @param {string} name */
	function choose(name) {
		if (name !== camera) go("cameras", { camera: name });
		else if (mayLeave()) show(name);
	}

	/** @param {string} words @param {any} [stored] the camera to show then */
	async function changed(words, stored) {
		await reloadCameras({ stored });
		show(stored?.name ?? null);
		announce(words);
	}

	return html`
		<div class="stack">
			<div class="row ends">
				<h2>Cameras</h2>
				<div class="row">
					<button class="primary" onClick=${begin}>New camera</button>
					<${FileButton}
						of=${{ accept: ".json,application/json", "aria-label": "Cameras to import" }}
						onFiles=${([first]) => setFile(first ?? null)}
					>
						Import
					<//>
					<button disabled=${!cameras?.length} onClick=${() => exportCameras(cameras ?? [], "cameras")}>
						Export all
					</button>
				</div>
			</div>
			<div class="cameras">
				<section class="card" aria-label="List of cameras">
					${cameras === null && html`<p class="hint">${lacksCameras ? "The list did not come." : "Loading ..."}</p>`}
					${cameras?.length === 0 &&
					html`<p>There is no camera yet. Make one from its lens specs, or <a href="#calibrate">measure it</a> with a printed sheet.</p>`}
					${(filter || (cameras?.length ?? 0) > A_PAGE / 2) &&
					html`<label class="field">
						Find
						<input type="search" value=${filter} onInput=${(event) => setFilter(event.target.value)} />
					</label>`}
					${found.length > 0 &&
					html`<ul class="camera-list">
						${found.slice(0, most).map(
							(one) => html`<li key=${one.name}>
								<button
									aria-pressed=${open.kind === "read" && open.name === one.name}
									onClick=${() => choose(one.name)}
								>
									<span class="name">${one.name}</span>
									<span class="hint">
										${`k_cam ${short(one.k_cam_px)} px, focus ${short(one.focus_distance_m)} m, ${one.image_width_px}×${one.image_height_px}`}
									</span>
									<span class="badge">${SOURCES[one.source]}</span>
								</button>
							</li>`,
						)}
					</ul>`}
					${found.length > most &&
					html`<button onClick=${() => setMost(most + A_PAGE)}>
						Show more (${found.length - most} left)
					</button>`}
				</section>
				<div class="stack">
					${open.kind === "none" &&
					!!cameras?.length &&
					html`<p class="hint">Choose a camera to see what it can measure.</p>`}
					${(open.kind === "new" || edited) &&
					html`<${CameraForm}
						key=${edited?.name}
						editing=${edited}
						onSaved=${changed}
						onTyped=${() => setTyped(true)}
						onCancel=${() => show(edited?.name ?? null)}
					/>`}
					${open.kind === "read" && cameras && !read && html`<p class="notice">There is no camera ${open.name}.</p>`}
					${read &&
					html`<${CameraCard}
						key=${`${read.name} ${read.revision}`}
						...${{ camera: read, opened: open, go }}
						onEdit=${() => turnTo({ kind: "edit", camera: read })}
						onDeleted=${() => changed(`Camera ${read.name} is deleted.`)}
						onStale=${reloadCameras}
					/>`}
				</div>
			</div>
			${file &&
			html`<${ImportDialog}
				file=${file}
				onClose=${(stored) => {
					setFile(null);
					if (stored > 0) changed(`${counted(stored, "camera is", "cameras are")} imported.`);
				}}
			/>`}
		</div>
	`;
}

/** @param {CameraCardProps} props */
function CameraCard({ camera, opened, go, onEdit, onDeleted, onStale }) {
	const path = `cameras/${encodeURIComponent(camera.name)}`;
	const [curve, setCurve] = useState(/** @type {any} */ (null));
	const [problem, setProblem] = useProblem();
	const [attempt, setAttempt] = useState(0);
	const [isDeleting, setIsDeleting] = useState(false);
	const { lens, intrinsics } = camera;
	const title = useRef(/** @type {?HTMLHeadingElement} */ (null));
	useEffect(() => arriveAt(title.current), [opened]);
	useEffect(() => {
		const stop = new AbortController();
		setProblem(null);
		getJson(`${path}/curve`, { signal: stop.signal }).then(setCurve, (error) => stop.signal.aborted || setProblem(error));
		return () => stop.abort();
	}, [attempt]);
	return html`
		<article class="card" aria-label=${camera.name}>
			<div class="row ends">
				<h3 tabindex="-1" ref=${title}>${camera.name}</h3>
				<span class="row">
					<span class="badge">${SOURCES[camera.source]}</span>
					<span class="badge">revision ${camera.revision}</span>
				</span>
			</div>
			${camera.description && html`<p>${camera.description}</p>`}
			<div class="row">
				<button class="primary" onClick=${() => go("depth", { camera: camera.name })}>Measure depth</button>
				<button onClick=${onEdit}>Edit</button>
				<button onClick=${() => go("calibrate", { camera: camera.name })}>Calibrate</button>
				<button onClick=${() => exportCameras([camera], camera.name)}>Export</button>
				<button class="danger" onClick=${() => setIsDeleting(true)}>Delete</button>
			</div>
			<${CameraCurve} camera=${camera} points=${curve?.points ?? null} />
			<${ProblemBox} problem=${problem} onRetry=${() => setAttempt(attempt + 1)} />
			<dl class="facts">
				<dt>Image</dt><dd>${camera.image_width_px} × ${camera.image_height_px} px</dd>
				<dt>Focus distance</dt><dd>${short(camera.focus_distance_m, 4)} m</dd>
				<dt>gamma</dt><dd>${short(camera.gamma_px)} px</dd>
				${!lens && camera.f_number && html`<dt>Aperture</dt><dd>f/${camera.f_number}</dd>`}
				${lens &&
				html`<dt>Lens</dt>
					<dd>${lens.focal_length_mm} mm f/${lens.f_number}, ${lens.pixel_pitch_um} µm pixels, sensor ${lens.sensor_width_px} px wide, k_r ${lens.k_r}</dd>`}
				${intrinsics &&
				html`<dt>Intrinsics</dt><dd>${intrinsicsIn(camera)}</dd>`}
				<dt>Changed</dt><dd>${when(camera.updated_at)}</dd>
			</dl>
			<${Revisions} path=${`${path}/revisions`} />
			${isDeleting && html`<${DeleteDialog} onClose=${() => setIsDeleting(false)} ...${{ camera, path, onDeleted, onStale }} />`}
		</article>
	`;
}

/** @param {{path: string}} props */
function Revisions({ path }) {
	const [items, setItems] = useState(/** @type {any[]} */ ([]));
	const [cursor, setCursor] = useState(/** @type {?string} */ (null));
	const [problem, setProblem, guard] = useProblem();

	/** @param {?string} after */
	function load(after) {
		setCursor(null); // until the next is known
		guard(async () => {
			const page = await getJson(`${path}?limit=${A_PAGE}${after ? `&cursor=${encodeURIComponent(after)}` : ""}`);
			setItems((before) => [...(after ? before : []), ...page.items]);
			setCursor(page.next_cursor);
			setProblem(null);
		});
	}

	return html`
		<details onToggle=${(event) => event.target.open && items.length === 0 && load(null)}>
			<summary>Revisions</summary>
			<${ProblemBox} problem=${problem} onRetry=${() => load(null)} />
			<ol class="revisions">
				${items.map(
					(one, place) => html`<li key=${one.revision}>
						<span class="row">
							<span class="badge">${one.revision}</span> ${when(one.updated_at)}
							<span class="hint">${SOURCES[one.source]}, k_cam ${short(one.k_cam_px, 4)} px</span>
						</span>
						${items[place + 1] && html`<span class="hint">${changesOf(items[place + 1], one)}</span>`}
					</li>`,
				)}
			</ol>
			${cursor && html`<button onClick=${() => load(cursor)}>Show earlier ones</button>`}
		</details>
	`;
}

/** @param {any} before @param {any} after */
function changesOf(before, after) {
	const changed = differences(before, after);
	if (changed.length === 0) return "the same numbers";
	return changed.map((one) => `${one.path.replace("/", " ")} ${one.before || "–"} → ${one.after || "–"}`).join("; ");
}

/** @param {DeleteDialogProps} props */
function DeleteDialog({ camera, path, onClose, onDeleted, onStale }) {
	const dialog = useRef(/** @type {?HTMLDialogElement} */ (null));
	const [problem, , guard] = useProblem();
	useEffect(() => dialog.current?.showModal(), []);

	const remove = () =>
		guard(async () => {
			await request(path, { method: "DELETE", headers: { "If-Match": `"${camera.revision}"` } });
			dialog.current?.close();
			onDeleted();
		});

	return html`
		<dialog ref=${dialog} aria-labelledby="delete-title" onClose=${onClose}>
			<div class="stack">
				<h2 id="delete-title">Delete ${camera.name}?</h2>
				<p>Photographs can no longer be sent with this camera. Its name is free again, and its revisions are kept.</p>
				<${ProblemBox} problem=${problem} />
				<div class="row">
					${[404, 412].includes(problem?.status ?? 0)
						? html`<button class="primary" onClick=${onStale}>See how it is now</button>`
						: html`<button class="danger" onClick=${remove}>Delete ${camera.name}</button>`}
					<button onClick=${() => dialog.current?.close()}>Keep it</button>
				</div>
			</div>
		</dialog>
	`;
}
