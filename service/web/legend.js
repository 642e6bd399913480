/** What the colours mean: a bar with ticks in metres, how often each occurs, and the two patterns. */

import { colourTable, placeOf } from "./colours.js";
import { inMetres, short } from "./numbers.js";
import { logTicks, ticksOf } from "./ticks.js";
import { html, useEffect, useRef } from "./vendor/preact.js";

/** @param {{look: Look, counts: Uint32Array | null}} props */
export function Legend({ look, counts }) {
	const { map, nearM, farM, hatchesNothing, dotsEither } = look;
	const bar = useRef(/** @type {?HTMLCanvasElement} */ (null));
	useEffect(() => {
		const context = bar.current?.getContext("2d");
		if (!context) return;
		const table = colourTable(map);
		const pixels = context.createImageData(256, 1);
		for (let at = 0; at < 256; at++) {
			pixels.data.set([...table.subarray(3 * (255 - at), 3 * (256 - at)), 255], 4 * at);
		}
		context.putImageData(pixels, 0, 0);
	}, [map]);
	return html`<figure class="depth-legend" aria-label=${`Colours: ${inMetres(nearM)} m near to ${inMetres(farM)} m far`}>
		${counts && html`<${Histogram} counts=${counts} />`}
		<canvas ref=${bar} width="256" height="1" aria-hidden="true"></canvas>
		<div class="depth-ticks" aria-hidden="true">
			${(farM / nearM < 4 ? ticksOf : logTicks)(nearM, farM).map(
				(depthM) =>
					html`<span key=${depthM} style=${{ left: `${100 * placeOf(depthM, nearM, farM)}%` }}>${short(depthM, 6)}</span>`,
			)}
		</div>
		<figcaption class="row hint">
			<span>metres, near to far</span>
			${hatchesNothing && html`<span class="choice"><i class="depth-key nothing"></i> no answer</span>`}
			${dotsEither && html`<span class="choice"><i class="depth-key either"></i> either side of focus</span>`}
		</figcaption>
	</figure>`;
}

/** @param {{counts: Uint32Array}} props */
function Histogram({ counts }) {
	const most = Math.max(1, ...counts);
	const steps = Array.from(counts, (count, bin) => `V${(100 - (100 * count) / most).toFixed(1)}H${bin + 1}`).join("");
	return html`<svg viewBox=${`0 0 ${counts.length} 100`} preserveAspectRatio="none" aria-hidden="true">
		<path d=${`M0 100${steps}V100Z`} />
	</svg>`;
}
