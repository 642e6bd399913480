/** Where files come from: a button that has them chosen, and a place to drop them. */

import { html, useRef, useState } from "./vendor/preact.js";

/**
 * @param {Record<string, any> & {of: object, onFiles: (files: File[]) => void}} props `of` has the attributes of the
 *   field behind it, the others are the button's
 */
export function FileButton({ of, onFiles, children, ...button }) {
	const field = useRef(/** @type {?HTMLInputElement} */ (null));
	return html`
		<button ...${button} onClick=${() => field.current?.click()}>${children}</button>
		<input
			ref=${field}
			type="file"
			hidden
			...${of}
			onChange=${({ target }) => {
				onFiles([...target.files]);
				target.value = ""; // the same file may be chosen again
			}}
		/>
	`;
}

/** @param {DropPlaceProps} props */
export function DropPlace({ kind = "", onFiles, children }) {
	const [isOver, setIsOver] = useState(false);
	return html`<div
		class=${`drop ${kind} ${isOver ? "over" : ""}`}
		onDragOver=${() => setIsOver(true)}
		onDragLeave=${() => setIsOver(false)}
		onDrop=${({ dataTransfer }) => {
			setIsOver(false);
			onFiles?.([...dataTransfer.files]);
		}}
	>
		${children}
	</div>`;
}
