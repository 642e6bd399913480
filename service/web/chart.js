/** Lines, bands and points over two axes as SVG, with the same numbers as a table. */

import { short } from "./numbers.js";
import { logTicks, ticksOf } from "./ticks.js";
import { html } from "./vendor/preact.js";
import { useWidth } from "./width.js";

const HEIGHT = 280;
const LEFT = 64;
const RIGHT = 14;
const TOP = 14;
const FLOOR = HEIGHT - 46; // where the axis of x is
const LINE = 16; // so that two words never run into each other
const LETTER = 7; // as wide as one may be
const MOST_ROWS = 30;
const TICK_DIGITS = 6; // they are round, and of a narrow range differ in the last ones alone

/** @param {ChartProps} props */
export function Chart({ title, x, y, series, marks = [] }) {
	const [box, width] = useWidth(480);
	const right = width - RIGHT;
	const points = series.flatMap((one) => one.points);
	if (points.length === 0) return null;
	const across = scaleOf(x, [...points.map((point) => point.x), ...marks.map((mark) => mark.x)], LEFT, right);
	const heights = points.flatMap(({ y: at, low = at, high = at }) => [at, low, high]);
	const up = scaleOf(y, heights, FLOOR, TOP);
	const named = series.filter(({ name }) => name);
	return html`
		<figure class="chart" ref=${box}>
			<figcaption class="row ends">
				<span>${title}</span>
				${named.length > 1 &&
				html`<span class="row hint" aria-hidden="true">
					${named.map((one) => html`<span class="row"><i class=${`key ${one.kind} ${one.tone}`}></i>${one.name}</span>`)}
				</span>`}
			</figcaption>
			<svg role="img" aria-label=${title} viewBox=${`0 0 ${width} ${HEIGHT}`} width=${width} height=${HEIGHT}>
				${up.ticks.map(
					(tick) => html`<g key=${tick}>
						<line class="grid" x1=${LEFT} x2=${right} y1=${up.scale(tick)} y2=${up.scale(tick)} />
						<text x=${LEFT - 6} y=${up.scale(tick) + 4} text-anchor="end">${short(tick, TICK_DIGITS)}</text>
					</g>`,
				)}
				${across.ticks.map(
					(tick) => html`<g key=${tick}>
						<line class="tick" x1=${across.scale(tick)} x2=${across.scale(tick)} y1=${FLOOR} y2=${FLOOR + 5} />
						<text x=${across.scale(tick)} y=${FLOOR + 19} text-anchor="middle">${short(tick, TICK_DIGITS)}</text>
					</g>`,
				)}
				<line class="axis" x1=${LEFT} x2=${right} y1=${FLOOR} y2=${FLOOR} />
				${marks.map((mark, row) => {
					const at = across.scale(mark.x);
					const isLeft = marks.length > 1 ? marks.every(({ x }) => x >= mark.x) : at > width / 2;
					const room = isLeft ? at - LEFT : right - at;
					const [aside, anchor] = isLeft === room > mark.label.length * LETTER ? [-5, "end"] : [5, "start"];
					return html`<g class="mark">
						<line x1=${at} x2=${at} y1=${TOP} y2=${FLOOR} />
						<text x=${at + aside} y=${TOP + 10 + row * LINE} text-anchor=${anchor}>${mark.label}</text>
					</g>`;
				})}
				${series.map((one) => drawn(one, across.scale, up.scale))}
				<text x=${right} y=${HEIGHT - 6} text-anchor="end">${x.label} (${x.unit})</text>
				<text x=${12} y=${TOP} transform=${`rotate(-90 12 ${TOP})`} text-anchor="end">
					${y.label} (${y.unit})
				</text>
			</svg>
			<details>
				<summary>As a table</summary>
				<div class="table-scroll" tabindex="0" role="region" aria-label=${`${title}, as a table`}>
					${series.map((one) => tabled(one, x, y))}
				</div>
			</details>
		</figure>
	`;
}

/** @param {Axis} axis @param {number[]} values @param {number} start where the least value stands @param {number} end @returns {Scale} */
function scaleOf({ from, to, isLog = false }, values, start, end) {
	const low = from ?? Math.min(...values);
	const high = Math.max(to ?? Math.max(...values), low + 1e-9);
	const bend = isLog ? Math.log : (/** @type {number} */ value) => value;
	const span = bend(high) - bend(low);
	return {
		scale: (value) => start + ((bend(value) - bend(low)) / span) * (end - start),
		ticks: isLog ? logTicks(low, high) : ticksOf(low, high),
	};
}

/** @param {Series} one @param {(value: number) => number} across @param {(value: number) => number} up */
function drawn({ kind, tone, points }, across, up) {
	const place = (/** @type {number} */ x, /** @type {number} */ y) => `${across(x).toFixed(1)} ${up(y).toFixed(1)}`;
	if (kind === "line") {
		return html`<path class=${`line ${tone}`} d=${`M${points.map(({ x, y }) => place(x, y)).join("L")}`} />`;
	}
	if (kind === "band") {
		const upper = points.map(({ x, y, high = y }) => place(x, high));
		const lower = points.map(({ x, y, low = y }) => place(x, low)).reverse();
		return html`<path class=${`band ${tone}`} d=${`M${[...upper, ...lower].join("L")}Z`} />`;
	}
	return points.map(
		({ x, y, label }) => html`<circle class=${`dot ${tone}`} cx=${across(x)} cy=${up(y)} r="3">
			${label && html`<title>${label}</title>`}
		</circle>`,
	);
}

/** @template T @param {T[]} all @param {number} most @returns {T[]} evenly fewer, where they are more */
export function thinned(all, most) {
	const every = Math.ceil(all.length / most);
	return all.filter((_, number) => number % every === 0);
}

/** @param {Series} one @param {Axis} x @param {Axis} y */
function tabled({ name, kind, points }, x, y) {
	const isBand = kind === "band";
	const head = [x.label, ...(isBand ? ["Low", "High"] : [y.label])];
	return html`<table>
		${name && html`<caption>${name}</caption>`}
		<thead>
			<tr>${head.map((words, at) => html`<th scope="col" class="number">${words} (${at ? y.unit : x.unit})</th>`)}</tr>
		</thead>
		<tbody>
			${thinned(points, MOST_ROWS).map((point) => {
				const numbers = isBand ? [point.x, point.low, point.high] : [point.x, point.y];
				return html`<tr>${numbers.map((number) => html`<td class="number">${short(number, 4)}</td>`)}</tr>`;
			})}
		</tbody>
	</table>`;
}
