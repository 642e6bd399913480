/** Which colours the depth has, from where to where, and what is marked on it. */

import { MAPS } from "./colours.js";
import { inMetres, toMetres } from "./numbers.js";
import { Choice } from "./text_field.js";
import { html, useState } from "./vendor/preact.js";

const STEPS = 1000;
const LEAST_RATIO = 1.01;

/** @param {{look: Look, facts: Facts, onLook: (look: Look) => void}} props */
export function Colours({ look, facts, onLook }) {
	const { spread, validShare, eitherShare } = facts;
	const change = (/** @type {Partial<Look>} */ part) => onLook({ ...look, ...part });
	return html`<section class="card stack" aria-label="Colours">
		<h3>Colours</h3>
		<${Choice} label="Map" value=${look.map} options=${MAPS} onChange=${(map) => change({ map })} />
		${spread &&
		html`
			<${Bound} title="Near" value=${look.nearM} ...${spread}
				onValue=${(value) => change({ nearM: Math.min(value, look.farM / LEAST_RATIO) })} />
			<${Bound} title="Far" value=${look.farM} ...${spread}
				onValue=${(value) => change({ farM: Math.max(value, look.nearM * LEAST_RATIO) })} />
			<div class="row">
				<button onClick=${() => change({ nearM: spread.nearM, farM: spread.farM })}>Fit to 2–98 %</button>
				<button onClick=${() => change({ nearM: spread.leastM, farM: spread.mostM })}>Whole range</button>
			</div>
		`}
		<${Switch} title=${`Hatch no answer (${share(1 - validShare)})`} isOn=${look.hatchesNothing}
			onSwitch=${(hatchesNothing) => change({ hatchesNothing })} />
		<${Switch} title=${`Dot either side (${share(eitherShare)})`} isOn=${look.dotsEither}
			onSwitch=${(dotsEither) => change({ dotsEither })} />
	</section>`;
}

/** @param {BoundProps} props */
function Bound({ title, value, leastM, mostM, onValue }) {
	// what is being typed stays, whatever is drawn anew meanwhile
	const [typed, setTyped] = useState(/** @type {?string} */ (null));
	const span = Math.log(mostM / leastM);
	return html`<div class="depth-bound">
		<span>${title}</span>
		<input
			type="range"
			min="0"
			max=${STEPS}
			value=${Math.round((STEPS * Math.log(value / leastM)) / span)}
			aria-label=${`${title} end of the colours`}
			aria-valuetext=${`${inMetres(value)} metres`}
			onInput=${(event) => onValue(leastM * Math.exp((span * event.target.value) / STEPS))}
		/>
		<input
			type="text"
			inputmode="decimal"
			value=${typed ?? inMetres(value)}
			aria-label=${`${title} end of the colours, metres`}
			onInput=${(event) => setTyped(event.target.value)}
			onChange=${(event) => {
				setTyped(null);
				const metres = toMetres(event.target.value);
				if (metres) onValue(metres);
			}}
		/>
		<span>m</span>
	</div>`;
}

/** @param {SwitchProps} props */
export function Switch({ title, isOn, onSwitch }) {
	return html`<label class="choice">
		<input type="checkbox" checked=${isOn} onChange=${(event) => onSwitch(event.target.checked)} />
		${title}
	</label>`;
}

/** @param {number} part */
function share(part) {
	return part > 0 && part < 0.01 ? "< 1 %" : `${Math.round(100 * part)} %`;
}
