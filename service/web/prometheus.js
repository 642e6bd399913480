/** What the service counts about itself, read from Prometheus' text format. */

/** @param {string} text */
export function readSamples(text) {
	return [...text.matchAll(/^(\w+)(?:\{(.*)\})? (\S+)$/gm)].map(([, name, labels = "", value]) => ({
		name,
		labels: Object.fromEntries([...labels.matchAll(/(\w+)="((?:[^"\\]|\\.)*)"/g)].map(([, key, text]) => [key, text])),
		value: Number(value.replace("Inf", "Infinity")),
	}));
}

/**
 * @param {Sample[]} samples
 * @param {string} name
 * @param {Record<string, string>} [labels] that it must have; others are summed over
 * @returns {number} 0 where nothing was counted yet
 */
export function valueOf(samples, name, labels = {}) {
	const wanted = Object.entries(labels);
	const fitting = samples.filter((one) => one.name === name && wanted.every(([key, text]) => one.labels[key] === text));
	return fitting.reduce((sum, { value }) => sum + value, 0);
}

/**
 * @param {Sample[]} samples
 * @param {string} name of a histogram of seconds
 * @param {Record<string, string>} [labels]
 * @returns {{count: number, meanS: number, within: (part: number) => number} | null} null where nothing was counted yet;
 *   `within` is the smallest bound counted against below which that part lies
 */
export function histogramOf(samples, name, labels = {}) {
	const count = valueOf(samples, `${name}_count`, labels);
	if (count === 0) return null;
	const bounds = [...new Set(samples.filter((one) => one.name === `${name}_bucket`).map(({ labels: { le } }) => le))];
	return {
		count,
		meanS: valueOf(samples, `${name}_sum`, labels) / count,
		within: (part) =>
			Number(bounds.find((le) => valueOf(samples, `${name}_bucket`, { ...labels, le }) >= part * count) ?? Infinity),
	};
}
