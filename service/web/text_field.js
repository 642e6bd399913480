/** Fields with their labels: a line of text, and under it what it is for or what is wrong with it; a choice. */

import { html } from "./vendor/preact.js";

/** @param {TextFieldProps} props */
export function TextField({ id, label, value, onInput, fault = "", hint, onChange, kind, list, disabled = false, invalid = fault !== "", role = "alert" }) {
	return html`
		<div class="field">
			<label for=${id}>${label}</label>
			<input
				type="text"
				...${{ id, list, value, disabled }}
				inputmode=${kind}
				autocomplete="off"
				spellcheck=${false}
				aria-invalid=${invalid}
				aria-describedby=${`${id}-told`}
				onInput=${(event) => onInput(event.target.value)}
				onChange=${(event) => onChange?.(event.target.value)}
			/>
			<span id=${`${id}-told`} role=${fault ? role : null} class=${fault ? "fault" : "hint"}>${fault || hint}</span>
		</div>
	`;
}

/** @param {ChoiceProps} props */
export function Choice({ label, value, options, onChange }) {
	return html`<label class="field">
		${label}
		<select value=${value} onChange=${(event) => onChange(event.target.value)}>
			${options.map(([one, words]) => html`<option key=${one} value=${one}>${words}</option>`)}
		</select>
	</label>`;
}
