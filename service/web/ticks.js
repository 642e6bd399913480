/** Round values for an axis. */

const MOST = 7;

/** @param {number} low @param {number} high */
export function ticksOf(low, high) {
	const raw = (high - low) / (MOST - 1);
	const power = 10 ** Math.floor(Math.log10(raw));
	const step = power * ([1, 2, 5].find((factor) => factor * power >= raw) ?? 10);
	const ticks = [];
	for (let count = Math.ceil(low / step - 1e-9); count * step <= high + step * 1e-9; count += 1) ticks.push(count * step);
	return ticks;
}

/** @param {number} low @param {number} high */
export function logTicks(low, high) {
	const ticks = [];
	const factors = high / low > 100 ? [1] : [1, 2, 5];
	for (let power = Math.floor(Math.log10(low)); 10 ** power <= high; power += 1) {
		const round = factors.map((factor) => Number((factor * 10 ** power).toPrecision(3)));
		ticks.push(...round.filter((tick) => tick >= low && tick <= high));
	}
	return ticks.length > 2 ? ticks : ticksOf(low, high);
}
