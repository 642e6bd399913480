/**
 * The service's API: requests that carry the API key, and every failure as a `Problem`.
 *
 * Paths are relative to the page ("cameras"), so that it works behind a prefix.
 */

import { keep, kept } from "./tab_store.js";

const KEY = "camind-api-key";
/** What the window hears when another key is used, or none. */
export const KEY_CHANGED = "camind:key";

/** Why a request failed: the service's problem+json, or that it does not answer (status 0). */
export class Problem extends Error {
	status = 0;
	title = "";
	detail = "";
	type = "about:blank";
	errors = /** @type {FieldProblem[]} */ ([]);
	requestId = /** @type {?string} */ (null);
	retryAfterS = /** @type {?number} */ (null);

	/** @param {{status: number, title: string, detail: string} & Partial<Problem>} about */
	constructor(about) {
		super(about.detail);
		Object.assign(this, about);
	}

	/** What is wrong with a field. @param {string} place */
	of(place) {
		return this.errors.find(({ pointer }) => pointer === place)?.detail;
	}

	/** Whether the same request may fare better later, or with a key. */
	get isPassing() {
		return [0, 401, 408, 429].includes(this.status) || this.status >= 500;
	}
}

/** @param {unknown} error @returns {Problem} the error, if it is one; else it is thrown on */
export function problemOf(error) {
	if (error instanceof Problem) return error;
	throw error;
}

let held = kept(KEY);

/** @returns {?string} the API key of this tab */
export const storedKey = () => held;

/** @param {?string} key */
function holdKey(key) {
	held = key;
	keep(KEY, key);
	dispatchEvent(new Event(KEY_CHANGED));
}

export const forgetKey = () => holdKey(null);

/** @type {KeyAsker} */
let ask = async () => null;

/** @param {KeyAsker} asker shows why the last key was refused, or null, and gives the key or null */
export function setKeyAsker(asker) {
	ask = asker;
}

/** @type {Promise<string | null> | null} */
let asking = null;

/** The key, asked for once however many requests want it. @param {?string} reason */
async function askedKey(reason) {
	asking ??= ask(reason).finally(() => {
		asking = null;
	});
	const key = await asking;
	if (key !== null && key !== held) holdKey(key);
	return key;
}

/**
 * Send with the key, as often as the service refuses it and another is given.
 *
 * @template {{status: number}} T
 * @param {(headers: Record<string, string>) => Promise<T>} send
 * @param {(answer: T) => Promise<Problem>} toProblem
 * @param {RequestOptions} options
 * @returns {Promise<T>}
 */
async function withKey(send, toProblem, { headers = {}, asks = true }) {
	for (;;) {
		const key = storedKey();
		const answer = await send(key ? { ...headers, Authorization: `Bearer ${key}` } : headers);
		if (answer.status >= 200 && answer.status < 300) return answer;
		const problem = await toProblem(answer);
		if (answer.status !== 401) throw problem;
		if (key !== null && key === storedKey()) forgetKey();
		const hasAnother = storedKey() !== null;
		if (!hasAnother && (!asks || (await askedKey(key && problem.detail)) === null)) throw problem;
	}
}

/** @param {unknown} error @param {unknown} [body] that was sent */
async function asProblem(error, body) {
	const isOurs = error instanceof Problem || (error instanceof DOMException && error.name === "AbortError");
	return isOurs ? error : noAnswer(body);
}

/** @param {unknown} body */
async function noAnswer(body) {
	for (const one of body instanceof FormData ? body.values() : [body]) {
		if (!(one instanceof File) || (await one.slice(0, 1).arrayBuffer().catch(() => null))) continue;
		const detail = "It is a folder, or was changed or moved since it was chosen: choose it again.";
		return new Problem({ status: 400, title: `The browser cannot read ${one.name}.`, detail });
	}
	const detail = "Check that it runs and that this device reaches it, then try again.";
	return new Problem({ status: 0, title: "The service does not answer.", detail });
}

/** @param {number} status @param {Headers} headers @param {string} text */
function readProblem(status, headers, text) {
	/** @type {any} */
	let told = {};
	try {
		told = JSON.parse(text) ?? {};
	} catch {
		// what stands in front of the service answers in its own words
	}
	return new Problem({
		status,
		type: String(told.type ?? "about:blank"),
		title: String(told.title ?? `The request failed (${status}).`),
		detail: String(told.detail ?? "The answer is not the service's own: something in front of it may have refused."),
		errors: Array.isArray(told.errors) ? told.errors : [],
		requestId: headers.get("X-Request-Id"),
		retryAfterS: Number(headers.get("Retry-After")) || null,
	});
}

/**
 * @param {string} path
 * @param {RequestOptions} [options]
 * @returns {Promise<Response>} a 2xx answer; throws `Problem` for any other, and an AbortError where it was aborted
 */
export async function request(path, options = {}) {
	const { method = "GET", body = null, signal = null } = options;
	try {
		return await withKey(
			(headers) => fetch(path, { method, headers, body, signal }),
			async (answer) => readProblem(answer.status, answer.headers, await answer.text()),
			options,
		);
	} catch (error) {
		throw await asProblem(error, body);
	}
}

/**
 * The body of an answer, which may break off too.
 *
 * @param {Response} answer
 * @param {"json" | "blob" | "text"} kind
 */
export async function readBody(answer, kind) {
	try {
		return await answer[kind]();
	} catch (error) {
		throw await asProblem(error);
	}
}

/** @type {(kind: "json" | "blob" | "text") => (path: string, options?: RequestOptions) => Promise<any>} */
const getter = (kind) => async (path, options) => readBody(await request(path, options), kind);

export const getJson = getter("json");
export const getBlob = getter("blob");
export const getText = getter("text");

/** @param {Headers} headers of an answer of `POST /depth` */
export function readDepthHeaders(headers) {
	return {
		focusM: Number(headers.get("Camind-Focus-Distance-M")),
		revision: Number(headers.get("Camind-Camera-Revision")),
		model: headers.get("Camind-Model") ?? "",
		warnings: (headers.get("Camind-Warnings") ?? "").split("; ").filter(Boolean),
	};
}

/** @param {string} path @param {unknown} body @param {RequestOptions} [options] */
export function sendJson(path, body, { method = "POST", headers = {}, ...options } = {}) {
	const about = { ...headers, "Content-Type": "application/json" };
	return getJson(path, { ...options, method, headers: about, body: JSON.stringify(body) });
}

/** @param {any} camera @param {?number} revision that it replaces; null for a new camera @returns {Promise<any>} the camera as it is stored */
export function storeCamera(camera, revision) {
	if (revision === null) return sendJson("cameras", camera).catch(tellTaken);
	const headers = { "If-Match": `"${revision}"` };
	return sendJson(`cameras/${encodeURIComponent(camera.name)}`, camera, { method: "PUT", headers });
}

/** @param {unknown} error */
function tellTaken(error) {
	const problem = problemOf(error);
	if (problem.status !== 409) throw problem;
	const detail = "This name is taken: open that camera to change it.";
	throw new Problem({ ...problem, detail, errors: [{ pointer: "#/name", detail }] });
}

/** @param {RequestOptions} [options] @returns {Promise<any[]>} the cameras as they are now, by name */
export async function everyCamera(options) {
	const found = [];
	let cursor = null;
	do {
		const after = cursor === null ? "" : `&cursor=${encodeURIComponent(cursor)}`;
		const page = await getJson(`cameras?limit=200${after}`, options);
		found.push(...page.items);
		cursor = page.next_cursor;
	} while (cursor !== null);
	return found;
}

/** Send a body with progress. @param {string} path @param {UploadOptions} [options] */
export async function upload(path, options = {}) {
	return withKey(
		(headers) => sendWithProgress(path, { ...options, headers }),
		async ({ status, headers, body }) => readProblem(status, headers, await asText(body)),
		options,
	);
}

/** @param {unknown} body */
async function asText(body) {
	if (body instanceof Blob) return body.text();
	return typeof body === "string" ? body : JSON.stringify(body);
}

/** @type {(path: string, options: UploadOptions) => Promise<{status: number, headers: Headers, body: any}>} */
function sendWithProgress(path, { method = "POST", headers = {}, body = null, signal, onProgress, onReceived, responseType = "" }) {
	return new Promise((resolve, reject) => {
		const sent = new XMLHttpRequest();
		const abort = () => sent.abort();
		const tellAborted = () => reject(new DOMException("The request was aborted.", "AbortError"));
		sent.open(method, path);
		sent.responseType = responseType;
		for (const [name, value] of Object.entries(headers)) sent.setRequestHeader(name, value);
		const part = (/** @type {ProgressEvent} */ { lengthComputable, loaded, total }) =>
			lengthComputable && total > 0 ? loaded / total : null;
		if (onProgress) sent.upload.onprogress = (event) => onProgress(part(event));
		if (onReceived) sent.onprogress = (event) => onReceived(part(event));
		sent.onload = () => {
			const lines = sent.getAllResponseHeaders().trim().split("\r\n");
			const pairs = lines.map((line) => /** @type {[string, string]} */ (line.split(/:\s*(.*)/s).slice(0, 2)));
			resolve({ status: sent.status, headers: new Headers(pairs.filter(([name]) => name)), body: sent.response });
		};
		sent.onerror = () => noAnswer(body).then(reject);
		sent.onabort = tellAborted;
		sent.onloadend = () => signal?.removeEventListener("abort", abort);
		signal?.addEventListener("abort", abort);
		if (signal?.aborted) tellAborted();
		else sent.send(body);
	});
}

/**
 * Read what the service's events hold until the stream ends; EventSource cannot send a key.
 *
 * @param {string} path
 * @param {{signal?: AbortSignal, onEvent: (content: any) => void}} options
 */
export async function events(path, { signal, onEvent }) {
	const answer = await request(path, { signal, asks: false, headers: { Accept: "text/event-stream" } });
	const reader = /** @type {ReadableStream<Uint8Array>} */ (answer.body).getReader();
	const decoder = new TextDecoder();
	let text = "";
	try {
		for (;;) {
			const { done, value } = await reader.read();
			if (done) return;
			const lines = (text + decoder.decode(value, { stream: true })).split("\n");
			text = lines.pop() ?? "";
			// the service writes each as one line; the others are its ids and signs of life
			for (const line of lines) if (line.startsWith("data:")) onEvent(JSON.parse(line.slice(5)));
		}
	} catch (error) {
		throw await asProblem(error);
	}
}
