/** Asks the worker; what it answers comes as a promise. */

/** @typedef {import("./depth_worker.js").Work} Work */

export class DepthReader {
	constructor() {
		this.worker = new Worker(new URL("depth_worker.js", import.meta.url), { type: "module" });
		/** @type {Map<number, {resolve: (result: any) => void, reject: (error: Error) => void}>} */
		this.waiting = new Map();
		this.asked = 0;
		this.worker.onmessage = ({ data: { id, result, failure } }) => {
			const { resolve, reject } = /** @type {{resolve: Function, reject: Function}} */ (this.waiting.get(id));
			this.waiting.delete(id);
			if (failure === undefined) resolve(result);
			else reject(new Error(failure));
		};
		/** @type {?Error} */
		this.fault = null;
		this.worker.onerror = () => {
			const fault = (this.fault = new Error("A part of the page did not come: load it again."));
			for (const { reject } of this.waiting.values()) reject(fault);
			this.waiting.clear();
		};
	}

	/** @template {keyof Work} Kind @param {Kind} kind @param {Parameters<Work[Kind]>[0]} about @returns {ReturnType<Work[Kind]>} */
	ask(kind, about) {
		const id = this.asked++;
		const answer = this.fault
			? Promise.reject(this.fault)
			: new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject }));
		this.worker.postMessage({ id, kind, about });
		return /** @type {ReturnType<Work[Kind]>} */ (answer);
	}
}

/**
 * Calls one at a time, and of those that come meanwhile only the last.
 *
 * @template T
 * @param {(wanted: T) => Promise<void>} work
 * @returns {(wanted: T) => void}
 */
export function latest(work) {
	let isBusy = false;
	/** @type {{wanted: T} | null} */
	let next = null;
	return async function call(wanted) {
		next = { wanted };
		if (isBusy) return;
		isBusy = true;
		try {
			while (next !== null) {
				const now = next.wanted;
				next = null;
				await work(now);
			}
		} finally {
			isBusy = false;
		}
	};
}
