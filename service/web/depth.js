/** The depth view: a camera, a photograph, and the metres in it. */

import { Problem, readDepthHeaders, upload } from "./api.js";
import { usableM } from "./camera_specs.js";
import { CloudView } from "./cloud_view.js";
import { depthPath } from "./commands.js";
import { Colours } from "./colour_controls.js";
import { DraftForm } from "./draft_form.js";
import { Exports } from "./exports.js";
import { DropPlace, FileButton } from "./file_choice.js";
import { Legend } from "./legend.js";
import { counted, inMetres, short, toMetres, withError } from "./numbers.js";
import { PHOTOGRAPHS, readShown, sending } from "./photograph_files.js";
import { ProblemBox, Warnings, useProblem } from "./problem_box.js";
import { DepthReader } from "./reader.js";
import { Distance, Readout, Timings } from "./readout.js";
import { Stage } from "./stage.js";
import { Tape } from "./tape.js";
import { Choice, TextField } from "./text_field.js";
import { html, useCallback, useEffect, useMemo, useRef, useState } from "./vendor/preact.js";

const SIDES = [
	["auto", "Let the model decide"],
	["near", "Nearer than focus"],
	["far", "Beyond focus"],
];
const STEPS = {
	upload: "Sending",
	work: "Waiting for a slot, reading the blur:",
	receive: "Receiving the answer",
	draw: "Drawing",
};
const MOST_PX = 1600;
const MANY = 10; // cameras are searched
const SETTLED_MS = 300;
const NOT_THE_FRAME = "urn:camind:problem:image-size-mismatch";
const NO_PHOTOGRAPH = /:(invalid-image|unsupported-kind|too-large)$/;
/** @type {Look} */
const FIRST_LOOK = { map: "cividis", nearM: 1, farM: 2, hatchesNothing: true, dotsEither: true };

/** @param {ViewProps} props */
export function DepthView({ shown, cameras, lacksCameras, camera: brought, reloadCameras, go, announce }) {
	const reader = useMemo(() => new DepthReader(), []);
	const [file, setFile] = useState(/** @type {?File} */ (null));
	const [leftOut, setLeftOut] = useState(0);
	const [photograph, setPhotograph] = useState(
		/** @type {{bitmap: ImageBitmap, width: number, height: number} | null} */ (null),
	);
	const [name, setName] = useState("");
	const [filter, setFilter] = useState("");
	const [side, setSide] = useState("auto");
	const [focus, setFocus] = useState("");
	const [focusM, setFocusM] = useState(/** @type {?number} */ (null));
	const [known, setKnown] = useState(/** @type {KnownDepth[]} */ ([]));
	const [attempt, setAttempt] = useState(0);
	const [isDrafting, setIsDrafting] = useState(false);
	const [phase, setPhase] = useState(/** @type {?Phase} */ (null));
	const [problem, setProblem] = useProblem();
	/** Why there is no reading, also when it was dismissed. */
	const [failure, setFailure] = useProblem();
	const [result, setResult] = useState(/** @type {?Result} */ (null));
	const [look, setLook] = useState(FIRST_LOOK);
	const [isOpening, setIsOpening] = useState(false);
	const [reading, setReading] = useState(/** @type {?Reading} */ (null));
	const [marks, setMarks] = useState(/** @type {Pixel[]} */ ([]));
	const [picture, setPicture] = useState("photograph");
	const [counts, setCounts] = useState(/** @type {Uint32Array | null} */ (null));
	const [measured, setMeasured] = useState(/** @type {?Measured} */ (null));
	const running = useRef(/** @type {?AbortController} */ (null));
	const opening = useRef(/** @type {?AbortController} */ (null));
	/** The pixel that is read, or else marked: of the next answer it is read, too. */
	const kept = useRef(/** @type {?Pixel} */ (null));
	kept.current = reading ?? marks.at(-1) ?? null;
	/** The camera and revision that was read by before the page knew it. */
	const ahead = useRef("");

	// who may not list cameras may still read by one that a link names
	const listed = cameras ?? (lacksCameras && name ? [{ name }] : []);
	const camera = listed.find((one) => one.name === name) ?? null;
	const found = listed.filter((one) => one.name.toLowerCase().includes(filter.toLowerCase()));
	const ask = { camera: name, side, focusM, known };

	useEffect(() => {
		if (brought === null || brought === name) return;
		setName(brought);
		setIsDrafting(false);
		forgetFocus();
	}, [brought]);

	function forgetFocus() {
		setFocus("");
		setFocusM(null);
	}

	const take = useCallback(async (/** @type {Iterable<File> | null | undefined} */ files) => {
		const given = Array.from(files ?? []);
		const taken = given.find(({ type }) => type.startsWith("image/")) ?? given[0];
		if (!taken) return;
		setLeftOut(given.length - 1);
		setResult(null);
		setProblem(null);
		setFailure(null);
		setReading(null);
		setMarks([]);
		setKnown([]);
		if (opening.current !== null) {
			opening.current.abort();
			setSide("auto");
			forgetFocus();
		} else setFocusM(toMetres(focus) ?? null); // who pastes may not have left the field
		setPhotograph(null);
		setIsOpening(true);
		setIsDrafting(false);
		setFile(taken);
		running.current = null;
		const { signal } = (opening.current = new AbortController());
		const open = async (/** @type {Blob} */ shown) =>
			signal.aborted ? null : reader.ask("photograph", { file: shown, mostPx: MOST_PX }).catch(() => null);
		const found = await readShown(taken, MOST_PX, open, signal);
		if (signal.aborted) return;
		setPhotograph(found);
		setIsOpening(false);
	}, [focus]);

	useFilesFromOutside(shown, take);

	useEffect(() => {
		setMeasured(null);
		if (marks.length < 2) return undefined;
		let isWanted = true;
		reader.ask("distance", { from: marks[0], to: marks[1] }).then((distance) => {
			if (!isWanted) return;
			setMeasured(distance ?? false);
			announce(distance ? `The points are ${withError(distance.distanceM, distance.sigmaM)} apart.` : "Their distance is not known.");
		});
		return () => {
			isWanted = false;
		};
	}, [marks]);

	useEffect(() => {
		if (file === null || camera === null) {
			setPhase(null);
			return undefined;
		}
		const isRead = ahead.current === `${name} ${camera.revision}`;
		ahead.current = "";
		if (isRead) return undefined;
		const abort = new AbortController();
		run(file, abort.signal, running.current ? SETTLED_MS : 0);
		running.current = abort;
		return () => abort.abort();
	}, [file, camera?.name, camera?.revision, side, focusM, known, attempt]);

	/** @param {File} sent @param {AbortSignal} signal @param {number} waitMs */
	async function run(sent, signal, waitMs) {
		const show = (/** @type {?Phase} */ next) => signal.aborted || setPhase(next);
		setProblem(null);
		setFailure(null);
		show({ step: "upload", fraction: 0 });
		await new Promise((resolve) => setTimeout(resolve, waitMs)); // arrow keys pass by
		if (signal.aborted) return;
		announce("Sending the photograph.");
		let isHeld = true; // the answer before
		try {
			// a phone shows little more, and four times as much would take four times as long to come
			const isSlow = /[23]g/.test(/** @type {any} */ (navigator).connection?.effectiveType);
			const longestPx = Math.min(MOST_PX, 2 * screen.width) / (isSlow ? 2 : 1);
			const answer = await upload(`${depthPath({ ...ask, format: "npz" })}&longest_px=${longestPx}`, {
				...sending(sent),
				// a Blob: it stays outside the page, and the worker takes its arrays out one by one
				responseType: "blob",
				signal,
				onProgress: (fraction) =>
					show(fraction === 1 ? { step: "work", since: performance.now() } : { step: "upload", fraction }),
				onReceived: (fraction) => show({ step: "receive", fraction }),
			});
			show({ step: "draw" });
			isHeld = false;
			const { facts, reading: again } = await reader.ask("load", { npz: answer.body, at: kept.current });
			signal.throwIfAborted();
			const { spread } = facts;
			const told = readDepthHeaders(answer.headers);
			if (spread) setLook((before) => ({ ...before, nearM: spread.nearM, farM: spread.farM }));
			setResult({
				asked: ask,
				file: sent,
				facts,
				...told,
				timings: readTimings(answer.headers.get("Server-Timing") ?? ""),
			});
			setReading(kept.current && again);
			setMarks((before) => [...before]);
			setPhase(null);
			if (told.revision !== camera?.revision) {
				ahead.current = `${name} ${told.revision}`;
				if (cameras) reloadCameras();
			}
			const words = spread
				? `Depth is ready: ${inMetres(spread.nearM)} to ${inMetres(spread.farM)} metres along the axis`
				: "The photograph gives no answer";
			announce([words, ...told.warnings].join(". "));
		} catch (error) {
			if (!isHeld) setResult((now) => (now === result ? null : now));
			if (!signal.aborted) fail(error instanceof Problem ? withSize(error) : unreadable(error));
		}
	}

	/** @param {Problem} why where the same may fare better later, the answer before it stays */
	function fail(why) {
		setPhase(null);
		if (!why.isPassing) setResult(null);
		setProblem(why);
		setFailure(why);
	}

	const pick = (/** @type {string} */ picked) => go("depth", { camera: picked, replaces: true });

	function cancel() {
		running.current?.abort();
		fail(new Problem({ status: 0, title: "Cancelled.", detail: "The service has stopped working on it." }));
	}

	const again = () => setAttempt((count) => count + 1);
	const isNotTheFrame = problem?.type === NOT_THE_FRAME;
	const wantsDraft = file !== null && cameras !== null && (isDrafting || camera === null);
	const warned = (/** @type {"camera" | "focus" | "result"} */ place) =>
		(result?.warnings ?? []).filter((text) => placeOfWarning(text) === place);
	const size = result?.facts ?? photograph;

	return html`
		<div class="depth stack">
			<h2 class="visually-hidden">Depth</h2>
			<div class="depth-ask">
				<div class="stack depth-camera">
					<div class="pair">
						<label class="field"
							>Camera
							<select
								value=${camera ? name : ""}
								aria-invalid=${isNotTheFrame}
								onChange=${(event) => pick(event.target.value)}
							>
								<option value="" disabled selected=${!camera}>${cameras ? "Choose its camera" : lacksCameras ? "The list did not come" : "Loading…"}</option>
								${(camera && !found.includes(camera) ? [camera, ...found] : found).map((one) => html`<option key=${one.name} value=${one.name}>${one.name}</option>`)}
							</select>
						</label>
						${listed.length > MANY &&
						html`<label class="field">
							Find a camera
							<input
								type="search"
								value=${filter}
								onInput=${(event) => setFilter(event.target.value)}
								onKeyDown=${({ key }) => key === "Enter" && found[0] && pick(found[0].name)}
							/>
						</label>`}
					</div>
					${cameras &&
					(camera
						? html`<p class="hint">${about(camera)}</p>`
						: name && html`<p class="notice">There is no camera ${name}.</p>`)}
					${cameras?.length === 0 &&
					html`<p class="hint">
						No camera is stored yet. Give a photograph, and its EXIF drafts one; or${" "}
						<button class="depth-link" onClick=${() => go("cameras")}>make one yourself</button>.
					</p>`}
					<${Warnings} texts=${warned("camera")} />
				</div>
				<${Choice} label="Side of the plane in focus" value=${side} options=${SIDES} onChange=${setSide} />
				<div class="stack">
					<${TextField}
						...${{ id: "depth-focus", label: "Focus distance of this shot, m", kind: "decimal", value: focus, onInput: setFocus }}
						fault=${toMetres(focus) === undefined ? "This is no distance in metres." : ""}
						hint=${camera && cameras ? `Left empty, the camera's: ${short(camera.focus_distance_m, 4)} m.` : ""}
						onChange=${(text) => toMetres(text) !== undefined && setFocusM(toMetres(text) ?? null)}
					/>
					<${Warnings} texts=${warned("focus")} />
				</div>
				<div class="row depth-files">
					<${FileButton} class=${file ? "" : "primary"} of=${{ accept: PHOTOGRAPHS }} onFiles=${take}>
						${file ? "Another photograph" : "Choose a photograph"}
					<//>
					<${FileButton} class="depth-take" of=${{ accept: "image/*", capture: "environment" }} onFiles=${take}>
						Take one
					<//>
				</div>
			</div>

			<${ProblemBox} problem=${problem} onRetry=${file && camera ? again : undefined} onClose=${() => setProblem(null)} />
			${isNotTheFrame &&
			cameras &&
			!isDrafting &&
			html`<p>
				If it is the whole frame of another camera,${" "}
				<button class="depth-link" onClick=${() => setIsDrafting(true)}>draft a camera from this photograph</button>.
				From a crop every depth would be wrong.
			</p>`}
			${wantsDraft &&
			html`<${DraftForm}
				key=${file}
				file=${file}
				onFailed=${setFailure}
				onStored=${async (stored) => {
					await reloadCameras({ stored });
					setProblem(null);
					pick(stored.name);
				}}
			/>`}
			${failure &&
			!problem &&
			file &&
			camera &&
			html`<div class="row"><button class="primary" onClick=${again}>Read the depth</button></div>`}
			<${Progress} phase=${phase} onCancel=${cancel} />
			${file &&
			html`<p class="hint">
				${file.name}${leftOut > 0 && `, without ${counted(leftOut, "other file")}: one is read at a time`}
			</p>`}

			${size === null
				? html`<${DropPlace} kind="depth-drop">
						<p><strong>Drop a photograph here, or paste one</strong></p>
						<p class="hint">
							${file
								? isOpening
									? "Opening it ..."
									: `This browser cannot show it; the service ${failure && NO_PHOTOGRAPH.test(failure.type) ? "cannot read it either" : "may still read it"}.`
								: "The whole frame as the camera stored it: a crop has lost its scale. It is read, and not kept."}
						</p>
					<//>`
				: html`<div class=${`depth-grid ${phase && result ? "depth-stale" : ""}`}>
						<div class="stack">
							${failure &&
							result &&
							html`<p class="notice">
								Still shown is the answer before: camera ${result.asked.camera}, side ${result.asked.side}, focused at ${short(result.focusM, 4)} m.
							</p>`}
							${result &&
							html`<${PictureTabs} picture=${picture} onPicture=${setPicture} />`}
							<div
								id="depth-picture-photograph"
								class="stack"
								...${result && { role: "tabpanel", "aria-labelledby": "depth-tab-photograph", hidden: picture !== "photograph" }}
							>
								<${Stage}
									...${{ reader, size, look, result, reading, marks, measured, known, announce }}
									bitmap=${photograph?.bitmap ?? null}
									onReading=${setReading}
									onMarks=${setMarks}
									onCounts=${setCounts}
								/>
							</div>
							${result &&
							html`<div
								id="depth-picture-cloud"
								role="tabpanel"
								aria-labelledby="depth-tab-cloud"
								hidden=${picture !== "cloud"}
							>
								<${CloudView}
									...${{ reader, result, look }}
									hasPhotograph=${photograph !== null}
									isShown=${shown && picture === "cloud"}
								/>
							</div>`}
							${result?.facts.spread && html`<${Legend} look=${look} counts=${counts} />`}
						</div>
						${(result || known.length > 0) &&
						html`<div class="stack depth-side-panel">
							${result &&
							html`<${Warnings} texts=${warned("result")} />
								<${Readout} reading=${reading} focusM=${result.focusM} />
								<${Distance} ...${{ marks, measured }} hasPoints=${result.facts.hasPoints} onClear=${() => (setMarks([]), setReading(null))} />`}
							<${Tape}
								...${{ reader, known }}
								mark=${marks.at(-1) ?? null}
								hasPoints=${result?.facts.hasPoints ?? false}
								onKnown=${setKnown}
							/>
							${result &&
							html`<${Colours} look=${look} facts=${result.facts} onLook=${setLook} />
								<${Exports} key=${JSON.stringify(result.asked)} ...${{ result, announce }} onChanged=${again} />
								<${Timings} timings=${result.timings} model=${result.model} />`}
						</div>`}
					</div>`}
		</div>
	`;
}

/** Photographs dropped on the view, or pasted. @param {boolean} shown @param {(files?: FileList) => void} take */
function useFilesFromOutside(shown, take) {
	useEffect(() => {
		if (!shown) return undefined;
		const end = new AbortController();
		const { signal } = end;
		document.addEventListener("drop", ({ dataTransfer }) => take(dataTransfer?.files), { signal });
		document.addEventListener("paste", ({ clipboardData }) => take(clipboardData?.files), { signal });
		return () => end.abort();
	}, [shown, take]);
}

/** @param {{picture: string, onPicture: (picture: string) => void}} props */
function PictureTabs({ picture, onPicture }) {
	const onKeyDown = (/** @type {KeyboardEvent} */ event) => {
		if (!["ArrowLeft", "ArrowRight"].includes(event.key)) return;
		event.preventDefault();
		const other = picture === "cloud" ? "photograph" : "cloud";
		onPicture(other);
		document.getElementById(`depth-tab-${other}`)?.focus();
	};
	return html`<div class="depth-tabs" role="tablist" aria-label="Views of the depth" onKeyDown=${onKeyDown}>
		${["photograph", "cloud"].map(
			(tab) => html`<button
				key=${tab}
				id=${`depth-tab-${tab}`}
				role="tab"
				aria-selected=${tab === picture}
				aria-controls=${`depth-picture-${tab}`}
				tabindex=${tab === picture ? 0 : -1}
				onClick=${() => onPicture(tab)}
			>
				${tab === "cloud" ? "3D" : "Picture"}
			</button>`,
		)}
	</div>`;
}

/** @param {{phase: Phase | null, onCancel: () => void}} props */
function Progress({ phase, onCancel }) {
	const [, tick] = useState(0);
	const isWorking = phase?.step === "work";
	useEffect(() => {
		if (!isWorking) return undefined;
		const timer = setInterval(() => tick((count) => count + 1), 100);
		return () => clearInterval(timer);
	}, [isWorking]);
	if (phase === null) return null;
	const fraction = "fraction" in phase ? phase.fraction : null;
	const part = fraction ? ` ${Math.round(100 * fraction)} %` : "";
	const time = "since" in phase ? ` ${((performance.now() - phase.since) / 1000).toFixed(1)} s` : "";
	return html`<div class="depth-progress">
		<progress key=${phase.step} aria-label="Progress" value=${fraction ?? undefined}></progress>
		<span>${STEPS[phase.step]}${part}${time}</span>
		<button onClick=${onCancel}>Cancel</button>
	</div>`;
}

/** @param {string} text @returns {"camera" | "focus" | "result"} beside what it should be read */
function placeOfWarning(text) {
	if (text.includes("focal length is")) return "focus";
	return text.includes("k_cam_px") ? "camera" : "result";
}

/** @param {any} camera */
function about(camera) {
	const { image_width_px, image_height_px, focus_distance_m, description } = camera;
	const range = usableM(camera);
	const reads = range ? `reads ${short(range[0], 2)} to ${short(range[1], 2)} m well` : "reads no depth well";
	const numbers = `${image_width_px} × ${image_height_px} px, focused at ${short(focus_distance_m, 4)} m, ${reads}`;
	return description ? `${description}. ${numbers}` : numbers;
}

/** @param {string} header `decode;dur=1.2` @returns {[string, number][]} */
function readTimings(header) {
	return Array.from(header.matchAll(/([\w-]+);dur=([\d.]+)/g), ([, stage, ms]) => [stage, Number(ms)]);
}

/** @param {Problem} problem @returns {Problem} with the size that would do, where it has too many pixels */
function withSize(problem) {
	const told = /(\d+)x(\d+) pixels, more than the (\d+) /.exec(problem.detail);
	if (problem.status !== 413 || told === null) return problem;
	const [width, height, most] = told.slice(1).map(Number);
	const scale = Math.sqrt(most / (width * height));
	const size = `${Math.floor(width * scale)}x${Math.floor(height * scale)}`;
	return new Problem({ ...problem, detail: `${problem.detail} Make it ${size} or smaller: the camera need not change.` });
}

/** @param {unknown} error */
function unreadable(error) {
	const detail = error instanceof Error ? error.message : String(error);
	return new Problem({ status: 0, title: "The answer cannot be shown.", detail });
}
