/** The calibration, step by step: print a sheet, photograph it, wait, and accept what was found. */

import { Problem, events, getJson, problemOf, storedKey, upload } from "./api.js";
import { Ended, Running } from "./job_step.js";
import { toMetres, when } from "./numbers.js";
import { Photographs, useLooks } from "./photo_step.js";
import { ProblemBox, useProblem } from "./problem_box.js";
import { SHEET, SheetStep, isMeasured, patternOf } from "./sheet_step.js";
import { keep, kept } from "./tab_store.js";
import { Table } from "./table.js";
import { TextField } from "./text_field.js";
import { html, useEffect, useRef, useState } from "./vendor/preact.js";

const STEPS = ["Sheet", "Photographs", "Calibration", "Result"];
const KEPT = "camind-sheet";
const RECENT = 10;
const AGAIN_MS = 1000;
const FINAL = new Set(["succeeded", "failed", "cancelled"]);
/** @type {Record<string, string>} */
const TONES = { succeeded: "good", failed: "bad", running: "warn", queued: "warn" };

/** Ask before the page goes: its own, which the cameras' form does not take away. @param {Event} event */
const stay = (event) => event.preventDefault();

/** @param {ViewProps} props */
export function CalibrateView({ shown, cameras, camera, reloadCameras, go, announce }) {
	const [step, setStep] = useState(0);
	const [sheet, setSheet] = useState(() => ({ ...SHEET, ...JSON.parse(kept(KEPT) ?? "{}") }));
	const [photos, setPhotos] = useState(/** @type {Photo[]} */ ([]));
	const [name, setName] = useState("");
	const [focus, setFocus] = useState("");
	const [job, setJob] = useState(/** @type {?any} */ (null));
	const [recent, setRecent] = useState(/** @type {any[]} */ ([]));
	const [problem, setProblem, guard] = useProblem();
	const [attempt, setAttempt] = useState(0);
	const [sent, setSent] = useState(/** @type {number | null | undefined} */ (undefined));
	const title = useRef(/** @type {?HTMLHeadingElement} */ (null));
	const hasMoved = useRef(false);
	const requestKey = useRef("");
	const known = cameras?.find((one) => one.name === name.trim()) ?? null;
	const focusM = toMetres(focus);
	const about = new URLSearchParams(/** @type {any} */ (patternOf(sheet)));
	if (known) about.set("camera", known.name);
	const query = isMeasured(sheet) ? String(about) : "";

	useLooks(photos, setPhotos, query);
	useJob(job, attempt, setJob, setProblem, (done) => {
		announce(`The calibration ${done.state === "cancelled" ? "is" : "has"} ${done.state}.`);
		setStep((now) => (now === 2 ? 3 : now)); // who has gone elsewhere is left there
		if (done.camera_revision !== null) reloadCameras();
	});

	/** @param {number} to */
	function move(to) {
		hasMoved.current = true;
		setStep(to);
	}

	const isHeld = photos.length > 0 && step < 2; // and not sent
	useEffect(() => {
		(isHeld ? addEventListener : removeEventListener)("beforeunload", stay);
	}, [isHeld]);
	useEffect(() => keep(KEPT, JSON.stringify(sheet)), [sheet]);
	useEffect(() => {
		if (hasMoved.current) title.current?.focus();
	}, [step]);
	useEffect(() => {
		if (shown && camera) setName(camera);
	}, [shown, camera]);
	useEffect(() => {
		requestKey.current = "";
	}, [photos.map(({ id, role }) => id + role).join(), query, name, focus]);
	useEffect(() => {
		if (shown) loadRecent();
	}, [shown, job?.state, job?.camera_revision, storedKey()]);

	async function loadRecent() {
		try {
			const { items } = await getJson(`calibrations?limit=${RECENT}`, { asks: false });
			setRecent(items);
			const live = items.find((/** @type {any} */ one) => !FINAL.has(one.state));
			// one that ran on while the page was away
			if (live && job === null && photos.length === 0 && step === 0) open(live.id);
		} catch (error) {
			problemOf(error);
		}
	}

	/** @param {string} id */
	const open = (id) =>
		guard(async () => {
			const found = await getJson(`calibrations/${id}`);
			setJob(found);
			move(FINAL.has(found.state) ? 3 : 2);
			setProblem(null);
			setAttempt((count) => count + 1);
		});

	function start() {
		if (isSending) return;
		const form = new FormData();
		const settings = { pattern: patternOf(sheet), focus_distance_m: focusM, register: false };
		form.append("settings", JSON.stringify(settings));
		for (const { role, file } of photos) form.append(role, file, file.name);
		requestKey.current ||= crypto.getRandomValues(new Uint32Array(4)).join("-");
		setProblem(null);
		setSent(0);
		guard(async () => {
			const { body } = await upload(`calibrate?camera=${encodeURIComponent(name.trim())}`, {
				body: form,
				headers: { "Idempotency-Key": requestKey.current },
				responseType: "json",
				onProgress: setSent,
			});
			requestKey.current = "";
			setJob(body);
			move(2);
		}).finally(() => setSent(undefined));
	}

	const isSending = sent !== undefined;
	const reached = job !== null ? (FINAL.has(job.state) ? 3 : 2) : 1;
	const focusFault = problem?.of("#/settings/focus_distance_m");
	const nameFault = problem?.of("camera");
	return html`
		<div class="stack">
			<h2 tabindex="-1" ref=${title}>Calibrate<span class="visually-hidden">, step ${step + 1}: ${STEPS[step]}</span></h2>
			<ol class="steps">
				${STEPS.map(
					(words, number) => html`<li>
						<button
							aria-current=${number === step ? "step" : undefined}
							disabled=${number > reached || (number === 2 && reached === 3)}
							onClick=${() => move(number)}
						>
							<span>${number + 1}</span> ${words}
						</button>
					</li>`,
				)}
			</ol>
			${step === 0 && html`<${SheetStep} sheet=${sheet} onChange=${setSheet} onNext=${() => move(1)} />`}
			${step === 1 &&
			html`
				<div class="card">
					<p>
						Lock focus, zoom and aperture. Take eight to twelve photographs of the whole sheet, some nearer and some farther than
						what is sharp, tilted by up to 25 degrees this way and that.
					</p>
					<div class="pair">
						<${TextField}
							...${{ id: "calibrate-name", label: "Camera", value: name, onInput: setName, fault: nameFault, list: "camera-names" }}
							hint=${known ? `Its focal length is used for distances; the result can become its revision ${known.revision + 1}.` : "A name for what is measured."}
						/>
						<${TextField}
							...${{ id: "calibrate-focus", label: "Focus distance (m), if you know it", value: focus, onInput: setFocus }}
							fault=${focusFault ?? (focusM === undefined ? "This is no distance in metres." : undefined)}
							hint="Left empty, it is found from the photographs."
						/>
					</div>
				</div>
				<${Photographs} ...${{ photos, query, announce }} focus=${focusM ?? null} onChange=${setPhotos} />
				<${ProblemBox} problem=${nameFault || focusFault ? null : problem} />
				<div class="row">
					<button
						class="primary"
						disabled=${!query || focusM === undefined || name.trim() === "" || !photos.some(({ role }) => role === "defocused")}
						onClick=${start}
					>
						Start the calibration
					</button>
					${name.trim() === "" && photos.length > 0 && html`<span class="hint">Name the camera first.</span>`}
					${!query && html`<span class="hint">Say on the sheet's page how long its ruler is.</span>`}
					${isSending &&
					html`<label class="sending hint">Sending the photographs ... <progress max="1" value=${sent ?? undefined}></progress></label>`}
				</div>
			`}
			${step === 2 && job && html`<${Running} job=${job} />`}
			${step === 3 &&
			job &&
			html`<${Ended}
				...${{ job, cameras, go }}
				onAccepted=${async (stored) => {
					setJob(stored);
					announce(`Stored as revision ${stored.camera_revision} of camera ${stored.camera}.`);
					await reloadCameras();
				}}
				onDiscard=${() => {
					announce(job.camera_revision === null ? "Discarded: nothing is stored." : "");
					setJob(null);
					move(photos.length > 0 ? 1 : 0);
				}}
				onAgain=${() => move(1)}
			/>`}
			${step !== 1 && html`<${ProblemBox} problem=${problem} onRetry=${step === 2 && job ? () => open(job.id) : undefined} />`}
			<${Recent} items=${recent} open=${job?.id ?? null} onOpen=${open} />
			<datalist id="camera-names">${(cameras ?? []).map((one) => html`<option value=${one.name}></option>`)}</datalist>
		</div>
	`;
}

/** @param {RecentProps} props */
function Recent({ items, open, onOpen }) {
	if (items.length === 0) return null;
	return html`
		<details class="card" open>
			<summary>Recent calibrations</summary>
			<${Table} label="Recent calibrations" head=${["Camera", "Begun", "State", "Open"]} numbers=${[3]}>
				${items.map(
					(one) => html`<tr key=${one.id}>
						<th scope="row" class="file">${one.camera}</th>
						<td>${when(one.created_at)}</td>
						<td>
							<span class=${`badge ${TONES[one.state] ?? ""}`}>${one.state}</span>
							${one.camera_revision !== null && html` <span class="hint">revision ${one.camera_revision}</span>`}
						</td>
						<td class="number">
							${one.id !== open &&
							html`<button class="quiet" aria-label=${`Open the calibration of ${one.camera}, ${one.state}`} onClick=${() => onOpen(one.id)}>
								Open
							</button>`}
						</td>
					</tr>`,
				)}
			<//>
		</details>
	`;
}

/**
 * Follows a calibration until it has ended; a stream that breaks is opened again.
 *
 * @param {?any} job
 * @param {number} attempt another one begins anew
 * @param {(job: any) => void} setJob
 * @param {(change: (old: Problem | null) => Problem | null) => void} setProblem
 * @param {(job: any) => void} onEnd
 */
function useJob(job, attempt, setJob, setProblem, onEnd) {
	const live = job !== null && !FINAL.has(job.state) ? job.id : null;
	useEffect(() => {
		if (live === null) return undefined;
		const stop = new AbortController();
		let met = /** @type {any} */ (null);
		const follow = async () => {
			while (!stop.signal.aborted) {
				let waitMs = AGAIN_MS;
				try {
					await events(`calibrations/${live}/events`, {
						signal: stop.signal,
						onEvent: (now) => {
							setJob(now);
							setProblem((old) => (old === met ? null : old));
							if (FINAL.has(now.state)) {
								stop.abort();
								onEnd(now);
							}
						},
					});
				} catch (error) {
					if (stop.signal.aborted) return;
					met = problemOf(error);
					setProblem(() => met);
					if ([401, 403, 404].includes(met.status)) return;
					waitMs = 1000 * (met.retryAfterS ?? 1);
				}
				await new Promise((resolve) => setTimeout(resolve, waitMs));
			}
		};
		follow();
		return () => stop.abort();
	}, [live, attempt]);
}
