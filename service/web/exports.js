/** The answer as a file in every format, and the request for it as something to paste. */

import { readBody, readDepthHeaders, request, storedKey } from "./api.js";
import { FORMATS, answerName, curlCommand, depthPath, pythonCommand } from "./commands.js";
import { mediaTypeOf, sending } from "./photograph_files.js";
import { ProblemBox, Warnings, useProblem } from "./problem_box.js";
import { save } from "./save.js";
import { Choice } from "./text_field.js";
import { html, useState } from "./vendor/preact.js";

/** @param {ExportsProps} props */
export function Exports({ result: { asked, file, revision, model, warnings }, announce, onChanged }) {
	const [format, setFormat] = useState("png");
	const [isBusy, setIsBusy] = useState(false);
	const [problem, setProblem, guard] = useProblem();
	const [told, setTold] = useState(/** @type {string[]} */ ([]));
	const [copied, setCopied] = useState(/** @type {{text: string, isCopied: boolean} | null} */ (null));
	const path = depthPath({ ...asked, format });
	const mediaType = mediaTypeOf(file);
	const answer = answerName(file.name, format);

	function download() {
		if (isBusy) return;
		setIsBusy(true);
		setProblem(null);
		setTold([]);
		guard(async () => {
			const got = await ask();
			setTold(got.told);
			if (got.body) save(got.body, answer);
			announce([...(got.body ? [`${answer} is downloaded`] : []), ...got.told].join(". "));
		}).finally(() => setIsBusy(false));
	}

	/** The service keeps no photograph: it is sent again. @returns {Promise<{body: Blob | null, told: string[]}>} no body where it is another camera's or model's now */
	async function ask() {
		const reply = await request(path, sending(file));
		const now = readDepthHeaders(reply.headers);
		if (now.revision !== revision || now.model !== model) {
			reply.body?.cancel();
			onChanged();
			const words = now.model === model ? `camera ${asked.camera} was changed to revision ${now.revision}` : `the model is ${now.model} now`;
			return { body: null, told: [`${words}: nothing is downloaded, the photograph is read again`] };
		}
		return { body: await readBody(reply, "blob"), told: now.warnings.filter((text) => !warnings.includes(text)) };
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
			options=${Object.entries(FORMATS)}
			onChange=${(value) => {
				setFormat(value);
				setCopied(null);
			}}
		/>
		<div class="row">
			<button onClick=${download}>${isBusy ? "Asking…" : "Download"}</button>
			<button onClick=${() => copy(curlCommand)}>Copy as curl</button>
			<button onClick=${() => copy(pythonCommand)}>Copy as Python</button>
			<button onClick=${() => print()}>Print</button>
		</div>
		<${ProblemBox} problem=${problem} onClose=${() => setProblem(null)} />
		<${Warnings} texts=${told} />
		${copied &&
		html`<p class="hint">
				${copied.isCopied ? "Copied." : "Copy it from here."} To be run in the photograph's
				folder${storedKey() !== null && ", with the API key in CAMIND_API_KEY"}.
			</p>
			<pre class="depth-command" tabindex="0" aria-label="Command">${copied.text}</pre>`}
	</section>`;
}
