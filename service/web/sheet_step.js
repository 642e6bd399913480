/** The first step: the sheet to print, and how large it came out of the printer. */

import { Problem, getBlob, storedKey } from "./api.js";
import { decimal, short } from "./numbers.js";
import { ProblemBox, useProblem } from "./problem_box.js";
import { save } from "./save.js";
import { Choice, TextField } from "./text_field.js";
import { html, useEffect, useState } from "./vendor/preact.js";

const WAIT_MS = 300;
const RULER_MM = 100;
const PAPERS = [
	["a4", "A4"],
	["letter", "Letter"],
];
const GRIDS = [
	["asymmetric_circles", "every other row shifted"],
	["symmetric_circles", "in line"],
];

/** @type {Sheet} */
export const SHEET = {
	kind: "asymmetric_circles",
	rows: "11",
	columns: "4",
	spacing_mm: "20",
	diameter_mm: "12",
	paper: "a4",
	ruler_mm: "100",
};

/** The pattern as it came out of the printer. @param {Sheet} sheet */
export function patternOf({ kind, rows, columns, spacing_mm, diameter_mm, ruler_mm }) {
	const scale = decimal(ruler_mm) / RULER_MM;
	const printed = (/** @type {string} */ length) => Number((decimal(length) * scale).toPrecision(6));
	return {
		kind,
		rows: decimal(rows),
		columns: decimal(columns),
		spacing_mm: printed(spacing_mm),
		diameter_mm: printed(diameter_mm),
	};
}

/** @param {Sheet} sheet */
export function isMeasured({ ruler_mm }) {
	return decimal(ruler_mm) >= 50 && decimal(ruler_mm) <= 200;
}

/** @param {SheetStepProps} props */
export function SheetStep({ sheet, onChange, onNext }) {
	const { picture, problem } = usePicture(sheet);
	const [failed, setFailed, guard] = useProblem();
	const isNone = problem?.status === 422;
	// of glass, film or larger paper there are such sheets
	const isElsewhere = isNone && problem.of("paper") !== undefined;
	const printed = patternOf(sheet);
	const hasScale = isMeasured(sheet);
	const fault = (/** @type {string} */ name) => problem?.of(name) ?? "";

	const field = (/** @type {keyof Sheet} */ name, /** @type {string} */ label, words = "") => html`
		<${TextField}
			...${{ id: `sheet-${name}`, label, value: sheet[name], kind: "decimal", fault: fault(name), hint: words }}
			invalid=${fault(name) !== "" || (name === "ruler_mm" && !hasScale)}
			onInput=${(value) => onChange({ ...sheet, [name]: value })}
		/>
	`;

	const choice = (/** @type {"paper" | "kind"} */ name, /** @type {string} */ label, /** @type {string[][]} */ options) => html`
		<${Choice} ...${{ label, options, value: sheet[name] }} onChange=${(value) => onChange({ ...sheet, [name]: value })} />
	`;

	/** @param {"pdf" | "svg"} kind */
	function download(kind) {
		setFailed(null);
		guard(async () => save(await getBlob(`calibrate/target.${kind}?${queryOf(sheet)}`), `camind-sheet.${kind}`));
	}

	const unseen = isElsewhere
		? "Not to be printed here. If you have such a sheet, go on: it is calibrated with as well."
		: isNone
			? "There is no such sheet."
			: (problem?.detail ?? "Drawing the sheet ...");

	return html`
		<div class="columns">
			<div class="card">
				<h3>Print the sheet</h3>
				<ol class="told">
					<li>Print at 100 %, without "fit to page".</li>
					<li>Measure the printed ruler with a real one. It should be ${RULER_MM} mm long.</li>
					<li>Glue the sheet to something flat.</li>
				</ol>
				<div class="row">
					<button class="primary" disabled=${isNone} onClick=${() => download("pdf")}>Download PDF</button>
					<button disabled=${isNone} onClick=${() => download("svg")}>Download SVG</button>
				</div>
				<${ProblemBox} problem=${failed} />
				${field("ruler_mm", "Measure this: the printed ruler is ... mm long", hasScale ? "" : "Between 50 and 200 mm.")}
				${hasScale &&
				html`<p class="hint" aria-live="polite">
					Circles of ${short(printed.diameter_mm, 4)} mm, ${short(printed.spacing_mm, 4)} mm apart: all distances hang on these.
				</p>`}
				<details>
					<summary>Another grid or paper</summary>
					<div class="pair">
						${choice("paper", "Paper", PAPERS)} ${choice("kind", "Grid", GRIDS)}
						${field("rows", "Rows")} ${field("columns", "Columns")}
						${field("spacing_mm", "Spacing (mm)")} ${field("diameter_mm", "Diameter (mm)")}
					</div>
				</details>
				${isNone && !problem.errors.length && html`<p class="fault" role="alert">${problem.detail}</p>`}
				<div class="row">
					<button class="primary" disabled=${!hasScale || (isNone && !isElsewhere)} onClick=${onNext}>Next: photographs</button>
				</div>
			</div>
			<figure class="card sheet">
				${picture
					? html`<img src=${picture} alt=${`The sheet: ${sheet.rows} rows and ${sheet.columns} columns of circles above a ruler`} />`
					: html`<p class="hint">${unseen}</p>`}
			</figure>
		</div>
	`;
}

/** @param {Sheet} sheet */
function queryOf({ ruler_mm: _, ...asked }) {
	return new URLSearchParams(Object.entries(asked).map(([name, text]) => [name, text.replace(",", ".")]));
}

/** @param {Sheet} sheet */
function usePicture(sheet) {
	const [state, setState] = useState({ picture: /** @type {?string} */ (null), problem: /** @type {?Problem} */ (null) });
	const query = String(queryOf(sheet));
	useEffect(() => {
		const stop = new AbortController();
		const timer = setTimeout(async () => {
			try {
				const drawn = await getBlob(`calibrate/target.svg?${query}`, { signal: stop.signal, asks: false });
				setState({ picture: URL.createObjectURL(drawn), problem: null });
			} catch (error) {
				if (error instanceof Problem) setState({ picture: null, problem: error });
			}
		}, state.picture ? WAIT_MS : 0);
		return () => {
			clearTimeout(timer);
			stop.abort();
		};
	}, [query, storedKey()]);
	useEffect(() => () => void (state.picture && URL.revokeObjectURL(state.picture)), [state.picture]);
	return state;
}
