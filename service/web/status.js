/** The view Status: whether the service can work, how busy it is, and how good its model is. */

import { Problem, getBlob, getJson, getText, storedKey } from "./api.js";
import { ProblemBox, useProblem } from "./problem_box.js";
import { histogramOf, readSamples, valueOf } from "./prometheus.js";
import { save } from "./save.js";
import { Table } from "./table.js";
import { html, useEffect, useState } from "./vendor/preact.js";

/** @type {Found} */
const NOTHING = { ready: null, model: null, samples: null, key: null, at: null };
const LOOK_EVERY_MS = 5000;
const STAGES = [
	["decode", "Decode"],
	["wait", "Wait for a slot"],
	["blur", "Blur graph"],
	["correct", "Camera correction"],
	["depth", "Depth graph"],
	["encode", "Encode"],
];
const SCORES = [
	["abs_rel", "AbsRel"],
	["constant_abs_rel", "Best constant"],
	["median_error", "Median error"],
	["rmse_m", "RMSE, m"],
];
const RANGES = {
	blur_px: "Blur, px",
	k_cam_px: "k_cam, px",
	focus_distance_m: "Focus distance, m",
	focal_length_px: "Focal length, px",
	gamma_px: "γ, px",
	depth_ratio: "Depth, of focus distance",
};

/** @param {ViewProps} props */
export function StatusView({ shown, announce }) {
	const [found, setFound] = useState(NOTHING);
	const [round, setRound] = useState(0);
	const state = found.ready === null ? "asked" : found.ready instanceof Problem ? "not ready" : "ready";

	useEffect(() => {
		if (!shown) return undefined;
		const stop = new AbortController();
		/** @type {ReturnType<typeof setTimeout> | undefined} */
		let timer;
		/** @param {Found} before */
		async function look(before) {
			const isUnseen = document.hidden && before.at !== null;
			const now = isUnseen ? before : await lookedAt(before, stop.signal);
			if (stop.signal.aborted) return;
			setFound(now);
			timer = setTimeout(look, LOOK_EVERY_MS, now);
		}
		look(NOTHING);
		return () => {
			stop.abort();
			clearTimeout(timer);
		};
	}, [shown, round]);
	useEffect(() => {
		if (state !== "asked") announce(`The service is ${state}.`);
	}, [state]);

	const again = () => setRound((number) => number + 1);
	return html`
		<div class="stack">
			<h2>Status</h2>
			<div class="columns">
				<${Readiness} ...${found} onRetry=${again} />
				<${Figures} title="Queue" samples=${found.samples} Content=${Queue} />
				<${Figures} title="Latency" samples=${found.samples} Content=${Latency} />
			</div>
			<${Model} model=${found.model} onRetry=${again} />
			<p class="hint">This page is made with Preact and htm (<a href="web/vendor/licences.txt">licences</a>).</p>
		</div>
	`;
}

/**
 * Look again. The first look may ask for a key, and what a key was refused is not asked for again with the same one.
 *
 * @param {Found} before
 * @param {AbortSignal} signal
 * @returns {Promise<Found>}
 */
async function lookedAt(before, signal) {
	/** @param {unknown} what */
	const isRefused = (what) =>
		what instanceof Problem && [401, 403].includes(what.status) && before.key === storedKey() && before.at !== null;
	const ready = await orProblem(getJson("health/ready", { signal }));
	if (ready instanceof Problem && ready.status === 0) {
		return { ...before, ready, samples: ready, at: new Date() };
	}
	const isModelKnown = before.model?.manifest?.name === (ready?.model ?? "");
	const model =
		isModelKnown || isRefused(before.model)
			? before.model
			: await orProblem(getJson("model", { signal, asks: before.at === null }));
	const samples = isRefused(before.samples)
		? before.samples
		: await orProblem(getText("metrics", { signal, asks: false }).then(readSamples));
	return { ready, model, samples, key: storedKey(), at: new Date() };
}

/** @template T @param {Promise<T>} asked @returns {Promise<T | Problem | null>} null where it was aborted */
async function orProblem(asked) {
	try {
		return await asked;
	} catch (error) {
		return error instanceof Problem ? error : null;
	}
}

/** @param {Found & {onRetry: () => void}} props */
function Readiness({ ready, samples, at, onRetry }) {
	const isFault = ready instanceof Problem;
	const fault = ready?.status === 0 ? "No answer" : "Not ready";
	const [tone, words] = ready === null ? ["", "Asking …"] : isFault ? ["bad", fault] : ["good", "Ready"];
	return html`
		<section class="card" aria-label="Service">
			<div class="row ends">
				<h3>Service</h3>
				<span class=${`badge ${tone}`}>${words}</span>
			</div>
			${isFault
				? html`<${ProblemBox} problem=${ready} onRetry=${onRetry} />`
				: ready !== null &&
					html`<dl class="facts">
						<dt>Model</dt>
						<dd>${ready.model}, warmed up</dd>
						<dt>Database</dt>
						<dd>${ready.database}, schema at ${ready.schema}</dd>
					</dl>`}
			<${Documents} wantsKey=${storedKey() !== null || (samples instanceof Problem && samples.status === 401)} />
			${at && html`<p class="hint">Looked at ${at.toLocaleTimeString()}, and every ${LOOK_EVERY_MS / 1000} s.</p>`}
		</section>
	`;
}

/** @param {{wantsKey: boolean}} props */
function Documents({ wantsKey }) {
	const [failed, setFailed, guard] = useProblem();
	if (!wantsKey) {
		return html`<p><a href="docs">API, to try out</a> · <a href="openapi.json">API as OpenAPI</a></p>`;
	}
	function download() {
		setFailed(null);
		guard(async () => save(await getBlob("openapi.json"), "openapi.json"));
	}
	return html`
		<div class="row"><button onClick=${download}>Download the API as OpenAPI</button></div>
		<${ProblemBox} problem=${failed} />
		<p class="hint">
			The API, to try out, is at <code>docs</code>. It asks for the key as well, which a browser does not send along with a
			link.
		</p>
	`;
}

/** @param {FiguresProps} props */
function Figures({ title, samples, Content }) {
	return html`
		<section class="card" aria-label=${title}>
			<h3>${title}</h3>
			${samples === null
				? html`<p class="hint">Asking …</p>`
				: samples instanceof Problem
					? html`<p>${noSamples(samples)}</p>`
					: html`<${Content} samples=${samples} />`}
		</section>
	`;
}

/** @param {Problem} problem */
function noSamples({ status, title, detail }) {
	if (status === 0) return "No answer.";
	if (status === 401) return "These figures need an API key with the scope admin.";
	if (status === 403) return "This API key may not read them: they need one with the scope admin.";
	return `${title} ${detail}`;
}

/** @param {{samples: Sample[]}} props */
function Queue({ samples }) {
	/** @param {string} name @param {Record<string, string>} [labels] */
	const value = (name, labels) => valueOf(samples, name, labels);
	const queued = value("camind_calibrations", { state: "queued" });
	return html`
		<dl class="facts">
			<dt>Photographs</dt>
			<dd>
				${value("camind_depth_slots_in_use")} of ${value("camind_depth_slots")} at work,
				${` ${value("camind_depth_queue_depth")} of ${value("camind_depth_queue_size")} waiting`}
			</dd>
			<dt>Calibrations</dt>
			<dd>
				${value("camind_calibrations", { state: "running" })} of 1 at work,
				${` ${queued} of ${value("camind_calibration_queue_size")} waiting`}
			</dd>
			<dt>Memory</dt>
			<dd>${(value("process_resident_memory_bytes") / 1e6).toFixed(0)} MB</dd>
			<dt>Running since</dt>
			<dd>${new Date(value("process_start_time_seconds") * 1000).toLocaleString()}</dd>
		</dl>
	`;
}

/** @param {{samples: Sample[]}} props */
function Latency({ samples }) {
	const answers = histogramOf(samples, "camind_request_duration_seconds", { method: "POST", path: "/depth" });
	if (answers === null) return html`<p>No depth map was asked for since the service started.</p>`;
	const { count, within } = answers;
	return html`
		<p>
			${count} ${count === 1 ? "answer" : "answers"} to photographs: half within ${bound(within(0.5))}, 95 % within
			${` ${bound(within(0.95))}.`}
		</p>
		<${Stages} samples=${samples} />
	`;
}

/** @param {number} seconds */
function bound(seconds) {
	return Number.isFinite(seconds) ? `${seconds} s` : "more than 30 s";
}

/** @param {{samples: Sample[]}} props */
function Stages({ samples }) {
	const stages = STAGES.map(([stage, meaning]) => ({
		stage,
		meaning,
		meanMs: 1000 * (histogramOf(samples, "camind_depth_stage_seconds", { stage })?.meanS ?? 0),
	}));
	const longestMs = Math.max(...stages.map(({ meanMs }) => meanMs));
	return html`
		<h4>Mean time of each stage</h4>
		<${Table} label="Mean time of each stage" head=${["Stage", "ms", ""]} numbers=${[1]}>
			${stages.map(
				({ stage, meaning, meanMs }) => html`<tr key=${stage}>
					<th scope="row">${meaning}</th>
					<td class="number">${meanMs.toFixed(meanMs < 10 ? 1 : 0)}</td>
					<td class="bars"><div style=${{ width: `${(100 * meanMs) / (longestMs || 1)}%` }}></div></td>
				</tr>`,
			)}
		<//>
	`;
}

/** @param {{model: any | Problem | null, onRetry: () => void}} props */
function Model({ model, onRetry }) {
	if (model instanceof Problem) return html`<${ProblemBox} problem=${model} onRetry=${onRetry} />`;
	return html`
		<section class="card" aria-label="Model">
			<div class="row ends">
				<h3>Model</h3>
				${model && html`<span class="badge">${model.manifest.name}</span>`}
			</div>
			${model === null ? html`<p class="hint">Asking …</p>` : html`<${ModelFacts} ...${model} />`}
		</section>
	`;
}

/** @param {{manifest: any, card: string}} props */
function ModelFacts({ manifest, card }) {
	return html`
		<p class="hint">
			Kind ${manifest.kind}, made ${new Date(manifest.created_at).toLocaleDateString()}. Trained within these ranges, in
			pixels of the image as the model reads it. Beyond them the service warns, and beyond those of blur and depth it gives
			no answer.
		</p>
		<dl class="figures">
			${Object.entries(RANGES).map(
				([name, title]) =>
					manifest.ranges[name] &&
					html`<div><dt>${title}</dt><dd>${manifest.ranges[name][0]} – ${manifest.ranges[name][1]}</dd></div>`,
			)}
		</dl>
		<${Scores} scores=${manifest.scores} />
		<details>
			<summary>Model card</summary>
			<pre tabindex="0">${card}</pre>
		</details>
	`;
}

/** @param {{scores: Record<string, number>}} props keys are "set.score", and a set's name may have dots */
function Scores({ scores }) {
	const sets = [...new Set(Object.keys(scores).map((key) => key.slice(0, key.lastIndexOf("."))))];
	if (sets.length === 0) return html`<p>This model comes without scores.</p>`;
	return html`
		<h4>Scores on ${sets.length} sets of pictures that no training saw</h4>
		<${Table} label="Scores" head=${["Set", ...SCORES.map(([, title]) => title)]} numbers=${[1, 2, 3, 4]}>
			${sets.map(
				(set) => html`<tr key=${set}>
					<th scope="row">${set}</th>
					${SCORES.map(([score]) => html`<td class="number">${figure(scores[`${set}.${score}`], score)}</td>`)}
				</tr>`,
			)}
		<//>
		<p class="hint">
			AbsRel is the mean error as a part of the distance; half of the pixels are off by less than the median error. The best
			constant is the AbsRel of the best single distance for each picture: a model that reads depth beats it.
		</p>
	`;
}

/** @param {number | undefined} value @param {string} score */
function figure(value, score) {
	// the best constant is exact where a picture has one distance only, and then says nothing
	if (value === undefined || (score === "constant_abs_rel" && value === 0)) return "–";
	return score === "median_error" ? `${(100 * value).toFixed(1)} %` : value.toFixed(3);
}
