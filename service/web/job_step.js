/** The third and fourth step: a calibration while it runs, and what it found. */

import { request, sendJson } from "./api.js";
import { intrinsicsIn } from "./camera_specs.js";
import { Chart, thinned } from "./chart.js";
import { counted, measure, short } from "./numbers.js";
import { ProblemBox, Warnings, useProblem } from "./problem_box.js";
import { Table } from "./table.js";
import { TextField } from "./text_field.js";
import { html, useEffect, useState } from "./vendor/preact.js";

const MOST_OUTLIERS = 50;
const MOST_DOTS = 600;
const VAGUE_RATIO = 2; // of the ends of k_cam's interval
const ROLES = { focused: "focused on it", defocused: "focus locked" };
const SPREADS = { disc: "a disc", gaussian: "a Gaussian" };

/** @param {{job: any}} props */
export function Running({ job }) {
	const [problem, , guard] = useProblem();
	const cancel = () => guard(() => request(`calibrations/${job.id}`, { method: "DELETE" }));
	const percent = Math.round(job.progress * 100);
	return html`
		<div class="card">
			<div class="row ends">
				<h3>${job.state === "queued" ? `The calibration of ${job.camera} waits` : `Calibrating ${job.camera}`}</h3>
				<button class="danger" onClick=${cancel}>Cancel</button>
			</div>
			<progress max="1" value=${job.progress} aria-label="Progress of the calibration"></progress>
			<p class="hint">
				${job.state === "queued" ? "Another one runs first. " : `${percent} %. `} It goes on when this page is closed: it is listed
				below then.
			</p>
			<${ProblemBox} problem=${problem} />
			<${Images} images=${job.images} />
		</div>
	`;
}

/** @param {{images: any[]}} props what each photograph gave */
function Images({ images }) {
	if (images.length === 0) return null;
	return html`
		<${Table} label="Photographs" head=${["Photograph", "Grid", "Circles", "Blur", "Distance", "Tilt", "Remarks"]} numbers=${[2, 3, 4, 5]}>
			${images.map(
				(one) => html`<tr key=${one.name}>
					<th scope="row" class="file" title=${ROLES[/** @type {keyof typeof ROLES} */ (one.role)]}>${one.name}</th>
					<td><span class=${`badge ${one.found ? "good" : "bad"}`}>${one.found ? "found" : "not found"}</span></td>
					<td class="number">${one.circles}</td>
					<td class="number">${measure(one.blur_px, " px")}</td>
					<td class="number">${measure(one.distance_m, " m", 4)}</td>
					<td class="number">${measure(one.tilt_deg, "°", 2)}</td>
					<td class="hint">${one.warnings.join("; ")}</td>
				</tr>`,
			)}
		<//>
	`;
}

/** @param {EndedProps} props */
export function Ended({ job, cameras, onAccepted, onDiscard, onAgain, go }) {
	if (job.result === null) {
		return html`
			<div class="card">
				<h3>${job.state === "cancelled" ? "The calibration was cancelled" : "The calibration found no camera"}</h3>
				${job.problem && html`<div class="problem" role="alert"><p>${job.problem}</p></div>`}
				<${Images} images=${job.images} />
				<div class="row"><button class="primary" onClick=${onAgain}>Back to the photographs</button></div>
			</div>
		`;
	}
	const { result } = job;
	const { low, high } = result.k_cam_px;
	const isVague = !(high <= VAGUE_RATIO * low);
	const outliers = result.samples.filter((/** @type {any} */ sample) => !sample.used);
	return html`
		<div class="stack">
			<div class="card">
				<div class="row ends">
					<h3>What was found for ${job.camera}</h3>
					${isVague && html`<span class="badge warn">not determined well</span>`}
				</div>
				<dl class="figures">
					<${Constant} name="k_cam" unit="px" of=${result.k_cam_px} />
					<${Constant} name="gamma" unit="px" of=${result.gamma_px} />
					<${Constant} name="Focus distance" unit="m" of=${result.focus_distance_m} />
				</dl>
				<${Warnings} texts=${result.warnings} />
				${isVague &&
				html`<p class="notice">
					k_cam may be anything from ${short(low)} to ${short(high)} px: add photographs that are clearly blurred, nearer and farther than
					what is sharp.
				</p>`}
				<${Accept} ...${{ job, cameras, isVague, onAccepted, onDiscard, onAgain, go }} />
			</div>
			<div class="columns">
				<div class="card"><${Fit} result=${result} /></div>
				<div class="card"><${Residuals} result=${result} /></div>
			</div>
			<div class="card">
				<h3>Lens</h3>
				<dl class="facts">
					<dt>Image</dt><dd>${result.image_width_px} × ${result.image_height_px} px</dd>
					<dt>Intrinsics</dt><dd>${intrinsicsIn(result)}</dd>
					<dt>Reprojection error</dt><dd>${short(result.reprojection_rms_px)} px rms</dd>
					${result.f_number && html`<dt>Aperture</dt><dd>f/${result.f_number}</dd>`}
					<dt>Point spread</dt><dd>${SPREADS[/** @type {keyof typeof SPREADS} */ (result.point_spread)]}</dd>
					<dt>Corners</dt>
					<dd>${result.corner_ratio === null ? "too few circles there" : `k_cam is ${short(result.corner_ratio)} times that of the middle`}</dd>
				</dl>
				<details>
					<summary>${counted(outliers.length, "outlier")} of ${counted(result.samples.length, "circle")}</summary>
					<${Outliers} outliers=${outliers} />
				</details>
				<details>
					<summary>${counted(job.images.length, "photograph")}</summary>
					<${Images} images=${job.images} />
				</details>
			</div>
		</div>
	`;
}

/** @param {ConstantProps} props */
function Constant({ name, unit, of: { value, low, high } }) {
	const words = low === high ? "as given" : `${short(low, 4)} to ${short(high, 4)} at 95 %`;
	return html`<div>
		<dt>${name}</dt>
		<dd>${short(value, 4)} <small>${unit}</small></dd>
		<dd class="interval">${words}</dd>
	</div>`;
}

/** @param {any} sample */
const told = (sample) => `${sample.image}, circle ${sample.circle}`;

/** @param {{result: Fit}} props */
function Fit({ result: { samples, curve, focus_distance_m: focus } }) {
	const dots = (/** @type {boolean} */ used) =>
		thinned(samples.filter((sample) => sample.used === used), MOST_DOTS).map((sample) => ({
			x: sample.depth_m,
			y: sample.blur_px,
			label: told(sample),
		}));
	const along = curve.map((at) => ({ x: at.depth_m, y: at.blur_px, low: at.low_px, high: at.high_px }));
	return html`<${Chart}
		title="Blur of every circle"
		x=${{ label: "distance", unit: "m", isLog: true }}
		y=${{ label: "blur", unit: "px", from: 0 }}
		marks=${[{ x: focus.value, label: "in focus" }]}
		series=${[
			{ name: "95 %", kind: "band", tone: "two", points: along },
			{ name: "circles", kind: "dots", tone: "one", points: dots(true) },
			{ name: "outliers", kind: "dots", tone: "three", points: dots(false) },
			{ name: "fit", kind: "line", tone: "two", points: along },
		].filter(({ points }) => points.length > 0)}
	/>`;
}

/** @param {{result: Fit}} props */
function Residuals({ result: { samples, curve } }) {
	const used = thinned(samples.filter((sample) => sample.used), MOST_DOTS);
	const points = used.flatMap((sample) => {
		const fitted = curveAt(curve, sample.depth_m);
		return fitted === null ? [] : [{ x: sample.depth_m, y: sample.blur_px - fitted, label: told(sample) }];
	});
	const most = Math.max(0.05, ...points.map(({ y }) => Math.abs(y)));
	return html`<${Chart}
		title="What the fit leaves"
		x=${{ label: "distance", unit: "m", isLog: true }}
		y=${{ label: "measured less fitted", unit: "px", from: -most, to: most }}
		series=${[{ name: "", kind: "dots", tone: "one", points }]}
	/>`;
}

/** The service's curve between two of its points. @param {any[]} curve @param {number} depth */
function curveAt(curve, depth) {
	const after = curve.findIndex(({ depth_m: at }) => at >= depth);
	if (after < 1) return null;
	const [from, to] = [curve[after - 1], curve[after]];
	const part = (depth - from.depth_m) / (to.depth_m - from.depth_m);
	return from.blur_px + part * (to.blur_px - from.blur_px);
}

/** @param {{outliers: any[]}} props */
function Outliers({ outliers }) {
	if (outliers.length === 0) return html`<p class="hint">Every circle fits.</p>`;
	return html`
		<${Table} label="Outliers" head=${["Photograph", "Circle", "At u, v (px)", "Distance (m)", "Blur (px)"]} numbers=${[1, 2, 3, 4]}>
			${outliers.slice(0, MOST_OUTLIERS).map(
				(one) => html`<tr>
					<th scope="row" class="file">${one.image}</th>
					<td class="number">${one.circle}</td>
					<td class="number">${Math.round(one.u_px)}, ${Math.round(one.v_px)}</td>
					<td class="number">${short(one.depth_m, 4)}</td>
					<td class="number">${short(one.blur_px)}</td>
				</tr>`,
			)}
		<//>
		${outliers.length > MOST_OUTLIERS && html`<p class="hint">and ${outliers.length - MOST_OUTLIERS} more</p>`}
	`;
}

/** @param {Parameters<typeof Ended>[0] & {isVague: boolean}} props */
function Accept({ job, cameras, isVague, onAccepted, onDiscard, onAgain, go }) {
	const [name, setName] = useState(job.camera);
	const [problem, setProblem, guard] = useProblem();
	const there = cameras?.find((camera) => camera.name === name.trim());
	const fault = problem?.of("#/camera") ?? "";

	useEffect(() => setName(job.camera), [job.id]);

	/** @param {Event} event */
	function accept(event) {
		event.preventDefault();
		guard(async () => {
			const stored = await sendJson(`calibrations/${job.id}/accept`, { camera: name.trim() });
			setProblem(null);
			onAccepted(stored);
		});
	}

	if (job.camera_revision !== null) {
		return html`
			<p><span class="badge good">stored</span> as revision ${job.camera_revision} of camera ${job.camera}.</p>
			<div class="row">
				<button class="primary" onClick=${() => go("depth", { camera: job.camera })}>Measure depth with it</button>
				<button onClick=${() => go("cameras", { camera: job.camera })}>See the camera</button>
				<button onClick=${onDiscard}>Another calibration</button>
			</div>
		`;
	}
	return html`
		<form class="stack" onSubmit=${accept}>
			<${ProblemBox} problem=${fault ? null : problem} />
			<${TextField}
				...${{ id: "accept-name", label: "Store it as camera", list: "camera-names", value: name, onInput: setName, fault }}
				hint=${there ? `It becomes revision ${there.revision + 1} of ${there.name}; the others are kept.` : "A new camera."}
			/>
			<div class="row">
				${isVague && html`<button type="button" class="primary" onClick=${onAgain}>Back to the photographs</button>`}
				<button class=${isVague ? "" : "primary"} disabled=${name.trim() === ""}>${there ? "Accept as a new revision" : "Accept as a new camera"}</button>
				<button type="button" onClick=${onDiscard}>Discard</button>
			</div>
		</form>
	`;
}
