/** What somebody has measured in the picture: depths that the service is told, and answers the rest by. */

import { decimal, inMetres } from "./numbers.js";
import { Choice, TextField } from "./text_field.js";
import { html, useState } from "./vendor/preact.js";

const WAYS = [
	["axis", "Along the lens' axis"],
	["straight", "Straight from the lens"],
];

const NEAREST_M = 0.001;
const FARTHEST_M = 99_999;

/** @param {TapeProps} props */
export function Tape({ reader, mark, hasPoints, known, onKnown }) {
	const [text, setText] = useState("");
	const [fault, setFault] = useState("");
	const [way, setWay] = useState("axis");

	/** @param {Event} event */
	async function add(event) {
		event.preventDefault();
		if (mark === null) return;
		const isStraight = hasPoints && way === "straight";
		const rayLength = isStraight ? (await reader.ask("at", mark)).rayLength : 1;
		if (rayLength === null) return setFault("By the camera's distortion no ray meets this pixel.");
		const depthM = decimal(text) / rayLength;
		if (!(depthM >= NEAREST_M && depthM <= FARTHEST_M)) return setFault("This is no distance in metres.");
		const others = known.filter(({ u, v }) => u !== mark.u || v !== mark.v);
		setText("");
		setFault("");
		onKnown([...others, { ...mark, depthM }]);
	}

	return html`<section class="card stack" aria-label="Known by a tape">
		<h3>Known by a tape</h3>
		${mark === null
			? html`<p class="hint">
					Click what you have measured, and say how far it is. Two or three things, near and far, tell where the lens was
					focused and which side things are on.
				</p>`
			: html`<form class="stack" onSubmit=${add}>
					<${TextField}
						id="depth-tape"
						label=${`From the lens to ${mark.u}, ${mark.v} in m`}
						kind="decimal"
						value=${text}
						fault=${fault}
						hint=${hasPoints ? "" : "Along the lens' axis."}
						onInput=${(typed) => {
							setText(typed);
							setFault("");
						}}
					/>
					${hasPoints && html`<${Choice} label="Measured" value=${way} options=${WAYS} onChange=${setWay} />`}
					<div class="row"><button>Use it</button></div>
				</form>`}
		${known.length > 0 &&
		html`<ul class="depth-known">
			${known.map(
				(one) => html`<li class="row ends" key=${`${one.u},${one.v}`}>
					<span>${inMetres(one.depthM)} m along the axis at ${one.u}, ${one.v}</span>
					<button
						aria-label=${`Forget ${inMetres(one.depthM)} m at ${one.u}, ${one.v}`}
						onClick=${() => onKnown(known.filter((other) => other !== one))}
					>Forget</button>
				</li>`,
			)}
		</ul>`}
	</section>`;
}
