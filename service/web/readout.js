/** What the answer says in words: at the pointer, between two points, and how long it took. */

import { inMetres } from "./numbers.js";
import { html } from "./vendor/preact.js";

/** @param {{reading: Reading | null, focusM: number}} props */
export function Readout({ reading, focusM }) {
	return html`<section class="card stack depth-readout" aria-label="Under the pointer">
		<h3>Under the pointer</h3>
		${reading === null
			? html`<p class="depth-metres hint">–</p>
					<p class="hint">Point at the picture, or go into it with Tab and the arrow keys.</p>`
			: html`<p class="depth-metres">
						${reading.depthM === null
							? "No answer here"
							: html`<strong data-value="depth">${inMetres(reading.depthM)} m</strong>${" "}
									<span data-value="sigma">± ${inMetres(reading.sigmaM ?? 0, reading.depthM)} m</span> along the axis`}
					</p>
					<dl class="facts">
						${reading.depthM === null
							? html`<dt>Why</dt>
								<dd>Blur here is too strong or too unsure, or tells a distance too near, too far or on the side ruled out.</dd>`
							: html`${reading.rayLength !== null &&
								html`<dt>Straight</dt>
									<dd><span data-value="straight">${inMetres(reading.depthM * reading.rayLength)} m</span> from the lens</dd>`}
								<dt>Side</dt>
								<dd data-value="side">${sideOf(reading.depthM, reading, focusM)}</dd>
								<dt>Or else</dt>
								<dd data-value="other">
									${reading.otherM === null
										? "no other distance fits"
										: `${inMetres(reading.otherM)} m, ${percent(reading.otherM < focusM ? reading.pNear : 1 - reading.pNear)}`}
								</dd>`}
						<dt>Blur</dt>
						<dd data-value="blur">${reading.blurPx.toFixed(2)} px</dd>
						<dt>Pixel</dt>
						<dd data-value="pixel">${reading.u}, ${reading.v}</dd>
					</dl>`}
	</section>`;
}

/** @param {DistanceProps} props */
export function Distance({ marks, measured, hasPoints, onClear }) {
	const says = () => {
		if (!hasPoints) return "Needs the camera's focal length: give the camera its lens or its intrinsics.";
		if (marks.length === 0) return "Click two points of the picture.";
		if (marks.length === 1) return "Click the second point.";
		return measured === false ? "One of the points has no answer, or no ray meets it by the camera's distortion." : "";
	};
	return html`<section class="card stack" aria-label="Distance in space">
		<h3>Distance in space</h3>
		${measured
			? html`<p class="depth-metres">
					<strong data-value="distance">${inMetres(measured.distanceM)} m</strong>${" "}
					<span data-value="distance-sigma">± ${inMetres(measured.sigmaM, measured.distanceM)} m</span>
				</p>`
			: html`<p class="hint">${says()}</p>`}
		${marks.length > 0 &&
		html`<div class="row"><button onClick=${onClear}>Clear points</button></div>`}
	</section>`;
}

/** @param {{timings: [string, number][], model: string}} props */
export function Timings({ timings, model }) {
	const totalMs = timings.reduce((sum, [, ms]) => sum + ms, 0);
	return html`<details class="card">
		<summary>The service took ${(totalMs / 1000).toFixed(2)} s</summary>
		<dl class="facts">${timings.map(([stage, ms]) => html`<dt>${stage}</dt><dd>${ms.toFixed(0)} ms</dd>`)}</dl>
		<p class="hint">${model}</p>
	</details>`;
}

/**
 * The side that the answer is on; both, where it is drawn over to the other's or is on the less likely one.
 *
 * @param {number} depthM
 * @param {Reading} reading
 * @param {number} focusM
 */
export function sideOf(depthM, { otherM, pNear }, focusM) {
	const isNear = depthM < focusM;
	const isDrawnOver = otherM !== null && otherM < focusM === isNear;
	if (isDrawnOver || (isNear ? pNear : 1 - pNear) < 0.5) {
		return `in doubt: nearer than focus ${percent(pNear)}, beyond it ${percent(1 - pNear)}`;
	}
	return isNear ? `nearer than focus, ${percent(pNear)}` : `beyond focus, ${percent(1 - pNear)}`;
}

/** @param {number} share */
function percent(share) {
	return `${Math.round(100 * share)}\u00a0%`;
}
