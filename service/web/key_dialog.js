/** Asks for the API key, which is kept for this tab only. */

import { setKeyAsker } from "./api.js";
import { html, useEffect, useRef, useState } from "./vendor/preact.js";

export function KeyDialog() {
	const [question, setQuestion] = useState(/** @type {?Question} */ (null));
	const [fault, setFault] = useState(/** @type {?string} */ (null));
	const dialog = useRef(/** @type {?HTMLDialogElement} */ (null));
	const input = useRef(/** @type {?HTMLInputElement} */ (null));

	useEffect(() => {
		setKeyAsker((reason) => new Promise((resolve) => setQuestion({ reason, answer: resolve })));
	}, []);
	useEffect(() => {
		if (question === null) return;
		setFault(question.reason);
		dialog.current?.showModal();
		input.current?.focus();
	}, [question]);

	/** @param {?string} key */
	function answer(key) {
		if (input.current) input.current.value = "";
		dialog.current?.close();
		setQuestion(null);
		question?.answer(key);
	}

	/** @param {Event} event */
	function submit(event) {
		event.preventDefault();
		const key = input.current?.value.trim() ?? "";
		// anything else could not be sent in a header
		if (/^[\x21-\x7e]+$/.test(key)) answer(key);
		else setFault("This is no API key: one begins with camind_ and has no spaces.");
	}

	return html`
		<dialog ref=${dialog} aria-labelledby="key-title" onCancel=${() => answer(null)}>
			<form class="stack" onSubmit=${submit}>
				<h2 id="key-title">API key</h2>
				<p>This service answers those who have a key. The key is kept for this tab only.</p>
				<label class="field">
					Key
					<input
						ref=${input}
						type="password"
						autocomplete="off"
						spellcheck=${false}
						aria-invalid=${fault !== null}
						aria-describedby="key-fault key-hint"
					/>
				</label>
				<p id="key-fault" class="fault" role="alert">${fault}</p>
				<p id="key-hint" class="hint">Whoever runs the service makes one with <code>camind keys create NAME</code>.</p>
				<div class="row">
					<button class="primary">Use this key</button>
					<button type="button" class="quiet" onClick=${() => answer(null)}>Cancel</button>
				</div>
			</form>
		</dialog>
	`;
}
