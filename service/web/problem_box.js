/** What went wrong and what to do about it, and what may go wrong. */

import { problemOf } from "./api.js";
import { html, useEffect, useState } from "./vendor/preact.js";

/** @param {ProblemBoxProps} props */
export function ProblemBox({ problem, onRetry, onClose }) {
	const waitS = useCountdown(problem);
	if (problem === null) return null;
	const { title, detail, errors, requestId, isPassing } = problem;
	const retry = isPassing ? onRetry : undefined;
	const isMoreThanDetail = errors.length > 1 || (errors.length === 1 && !detail.includes(errors[0].detail));
	return html`
		<div class="problem" role="alert">
			<p><strong>${title.replace(/\w$/, "$&.")}</strong> ${detail}</p>
			${isMoreThanDetail &&
			html`<ul>${errors.map((fault) => html`<li><code>${fault.pointer.replace(/^#\//, "")}</code> ${fault.detail}</li>`)}</ul>`}
			${requestId && html`<p class="hint" aria-live="off">Request ${requestId}</p>`}
			${(retry || onClose) &&
			html`<div class="row">
				${retry &&
				html`<button type="button" onClick=${retry}>
					Try again${waitS > 0 && html`<span aria-hidden="true"> (in ${waitS} s)</span>`}
				</button>`}
				${onClose && html`<button type="button" class="quiet" onClick=${onClose}>Dismiss</button>`}
			</div>`}
		</div>
	`;
}

/** @param {{texts: string[]}} props */
export function Warnings({ texts }) {
	if (texts.length === 0) return null;
	return html`<ul class="notice warnings">
		${texts.map((text) => html`<li key=${text}>${text.replace(/^[a-z](?!\w*_)/, (one) => one.toUpperCase())}</li>`)}
	</ul>`;
}

/** The problem there is, how it is set, and a guard for work that may meet one. */
export function useProblem() {
	const [problem, setProblem] = useState(/** @type {?Problem} */ (null));
	const guard = (/** @type {() => Promise<unknown>} */ work) => work().catch((error) => setProblem(problemOf(error)));
	return /** @type {const} */ ([problem, setProblem, guard]);
}

/** @param {?Problem} problem whose wait is counted down, in seconds */
function useCountdown(problem) {
	const [waitS, setWaitS] = useState(0);
	useEffect(() => {
		setWaitS(problem?.retryAfterS ?? 0);
		if (!problem?.retryAfterS) return undefined;
		const timer = setInterval(() => setWaitS((seconds) => Math.max(0, seconds - 1)), 1000);
		return () => clearInterval(timer);
	}, [problem]);
	return waitS;
}
