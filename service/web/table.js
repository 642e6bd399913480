/** A table that scrolls by itself where it is wider than its place. */

import { html } from "./vendor/preact.js";

/** @param {TableProps} props */
export function Table({ label, head, numbers = [], children }) {
	return html`<div class="table-scroll" tabindex="0" role="region" aria-label=${label}>
		<table>
			<thead>
				<tr>${head.map((words, at) => html`<th scope="col" class=${numbers.includes(at) ? "number" : ""}>${words}</th>`)}</tr>
			</thead>
			<tbody>${children}</tbody>
		</table>
	</div>`;
}
