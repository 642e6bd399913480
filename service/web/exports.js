/** The answer as a file in every format, and the request for it as something to paste. */

import { getBlob, problemOf, storedKey } from "./api.js";
import { FORMATS, answerName, curlCommand, depthPath, pythonCommand } from "./commands.js";
import { mediaTypeOf } from "./photograph_files.js";
import { ProblemBox, useProblem } from "./problem_box.js";
import { save } from "./save.js";
import { Choice } from "./text_field.js";
import { html, useState } from "./vendor/preact.js";

/** @param {{result: import("./depth.js").Result, announce: (text: string) => void}} props */
export function Exports({ result: { asked, file, npz }, announce }) {
	const [format, setFormat] = useState("png");
	const [isBusy, setIsBusy] = useState(false);
	const [problem, setProblem] = useProblem();
	const [copied, setCopied] = useState(/** @type {{text: string, isCopied: boolean} | null} */ (null));
	const path = depthPath({ ...asked, format });
	const mediaType = mediaTypeOf(file);
	const answer = answerName(file.name, format);

	async function download() {
		setIsBusy(true);
		setProblem(null);
		try {
			// the service keeps no photograph: it is sent again
			const asked = { method: "POST", body: file, headers: { "Content-Type": mediaType } };
			save(format === "npz" ? npz : await getBlob(path, asked), answer);
			announce(`${answer} is downloaded.`);
		} catch (error) {
			setProblem(problemOf(error));
		} finally {
			setIsBusy(false);
		}
	}

	/** @param {typeof curlCommand} write */
	async function copy(write) {
		const url = new URL(path, document.baseURI).href;
		const text = write({ url, photograph: file.name, mediaType, answer, hasKey: storedKey() !== null });
		let isCopied = true;
		try {
			await navigator.clipboard.writeText(text);
		} catch {
			isCopied = false; // without TLS a browser gives nobody the clipboard
		}
		setCopied({ text, isCopied });
		announce(isCopied ? "Copied." : "The browser did not allow copying: the command is below.");
	}

	return html`<section class="card stack" aria-label="Take it along">
		<h3>Take it along</h3>
		<${Choice}
			label="Format"
			value=${format}
			options=${Object.entries(FORMATS).map(([value, { says }]) => [value, says])}
			onChange=${(/** @type {string} */ value) => {
				setFormat(value);
				setCopied(null);
			}}
		/>
		<div class="row">
			<button type="button" disabled=${isBusy} onClick=${download}>${isBusy ? "Asking…" : "Download"}</button>
			<button type="button" onClick=${() => copy(curlCommand)}>Copy as curl</button>
			<button type="button" onClick=${() => copy(pythonCommand)}>Copy as Python</button>
		</div>
		<${ProblemBox} problem=${problem} onClose=${() => setProblem(null)} />
		${copied &&
		html`<p class="hint">
				${copied.isCopied ? "Copied." : "Copy it from here."} To be run in the photograph's
				folder${storedKey() !== null && ", with the API key in CAMIND_API_KEY"}.
			</p>
			<pre class="depth-command" tabindex="0" aria-label="Command">${copied.text}</pre>`}
	</section>`;
}
