/** The maps of one photograph: what they say at a pixel, between two, in colours, and as points. */

import { colourTable, placeOf } from "./colours.js";
import { readNpz } from "./npy.js";

const SAMPLES = 200_000;
const BINS = 64;
const LEAST_RATIO = 1.02;
// where neither side is three times likelier than the other or so, and both are apart
const EITHER = [0.3, 0.7];
const APART = 1.25;
const NOTHING = 0x80;
const HATCH = 0xb4;
const PATTERN_PX = 8;
// as the service's point clouds have it
const UNDISTORT_ROUNDS = 200;
const EXACT_PX = 1e-6;
const LEAST_STEP = 1e-3;
const MOST_OFF_PX = 0.5;

export class DepthMaps {
	/**
	 * @param {Map<string, NumpyArray>} arrays
	 * @param {{image_width_px?: number, image_height_px?: number}} [about] the photograph, if it is larger than its maps
	 */
	constructor(arrays, about = {}) {
		const take = (/** @type {string} */ name) => {
			const found = arrays.get(name);
			if (!found) throw new Error(`The answer lacks ${name}.`);
			return found.data;
		};
		this.depthM = take("depth_m");
		this.columns = arrays.get("depth_m")?.shape[1] ?? 0;
		this.rows = this.depthM.length / this.columns;
		this.width = about.image_width_px ?? this.columns;
		this.height = about.image_height_px ?? this.rows;
		this.otherM = take("depth_alt_m");
		this.pNear = take("p_near");
		this.sigmaM = take("sigma_m");
		this.blurPx = take("blur_px");
		const [fx, , cx, , fy, cy] = take("K");
		const [across, down] = [this.width / this.columns, this.height / this.rows];
		this.lens = { fx: fx * across, fy: fy * down, cx: (cx + 0.5) * across - 0.5, cy: (cy + 0.5) * down - 0.5 };
		this.distortion = Array.from(arrays.get("distortion")?.data ?? []);
	}

	/** @param {Blob} npz */
	static async read(npz) {
		const { arrays, comment } = await readNpz(npz);
		return new DepthMaps(arrays, JSON.parse(comment));
	}

	get hasPoints() {
		return Object.values(this.lens).every(Number.isFinite);
	}

	/** @returns {Facts} */
	facts() {
		const { depthM, width, height } = this;
		const step = Math.max(1, Math.floor(depthM.length / SAMPLES));
		const sample = new Float32Array(Math.ceil(depthM.length / step));
		let [known, valid, either, leastM, mostM] = [0, 0, 0, Infinity, 0];
		for (let pixel = 0; pixel < depthM.length; pixel++) {
			const depth = depthM[pixel];
			if (!(depth > 0)) continue;
			valid++;
			if (depth < leastM) leastM = depth;
			if (depth > mostM) mostM = depth;
			if (this.isEither(pixel)) either++;
			if (pixel % step === 0) sample[known++] = depth;
		}
		const sorted = sample.subarray(0, known).sort();
		const at = (/** @type {number} */ share) => sorted[Math.round(share * (known - 1))];
		const spread =
			known === 0
				? null
				: { leastM, nearM: at(0.02), farM: Math.max(at(0.98), at(0.02) * LEAST_RATIO), mostM: Math.max(mostM, leastM * LEAST_RATIO) };
		const all = depthM.length;
		return { width, height, hasPoints: this.hasPoints, validShare: valid / all, eitherShare: either / all, spread };
	}

	/** @param {number} pixel */
	isEither(pixel) {
		const pNear = this.pNear[pixel];
		const ratio = this.otherM[pixel] / this.depthM[pixel];
		return pNear > EITHER[0] && pNear < EITHER[1] && (ratio > APART || ratio < 1 / APART);
	}

	/** @param {number} u @param {number} v @returns {number} where in the maps a pixel of the photograph is */
	indexOf(u, v) {
		const [row, column] = [((v + 0.5) * this.rows) / this.height, ((u + 0.5) * this.columns) / this.width];
		return Math.floor(row) * this.columns + Math.floor(column);
	}

	/** @param {number} u @param {number} v @returns {Reading} */
	at(u, v) {
		const pixel = this.indexOf(u, v);
		const known = (/** @type {number} */ value) => (Number.isFinite(value) ? value : null);
		return {
			u,
			v,
			depthM: known(this.depthM[pixel]),
			otherM: known(this.otherM[pixel]),
			sigmaM: known(this.sigmaM[pixel]),
			pNear: this.pNear[pixel],
			blurPx: this.blurPx[pixel],
			rayLength: known(Math.hypot(...(this.ray(u, v) ?? [NaN]))),
		};
	}

	/**
	 * The distance in space between two pixels' points, with the error that both depths' errors give it.
	 *
	 * @param {{u: number, v: number}} from
	 * @param {{u: number, v: number}} to
	 * @returns {{distanceM: number, sigmaM: number} | null} null without a focal length, or where one has no answer
	 *   or is met by no ray
	 */
	distance(from, to) {
		const ends = [from, to].map(({ u, v }) => {
			const pixel = this.indexOf(u, v);
			const [ray, depth] = [this.ray(u, v) ?? [NaN, NaN, NaN], this.depthM[pixel]];
			return { ray, sigma: this.sigmaM[pixel], point: ray.map((part) => part * depth) };
		});
		const apart = ends[0].point.map((part, axis) => part - ends[1].point[axis]);
		const distanceM = Math.hypot(...apart);
		if (!Number.isFinite(distanceM)) return null;
		const shares = ends.map(({ ray, sigma }) => (dot(apart, ray) / distanceM) * sigma);
		return { distanceM, sigmaM: distanceM > 0 ? Math.hypot(...shares) : 0 };
	}

	/** @param {number} u @param {number} v @returns {number[] | null} where the pixel looks, 1 m along the optical axis; null where no ray meets it */
	ray(u, v) {
		const { fx, fy, cx, cy } = this.lens;
		const [x, y] = [(u - cx) / fx, (v - cy) / fy];
		if (this.distortion.every((term) => term === 0)) return [x, y, 1];
		const placed = (/** @type {number} */ a, /** @type {number} */ b) => {
			const { stretch, across, down } = bending(a, b, this.distortion);
			const offPx = Math.hypot(fx * (a * stretch + across - x), fy * (b * stretch + down - y));
			return { a, b, offPx, next: [(x - across) / stretch, (y - down) / stretch] };
		};
		let [at, step] = [placed(x, y), 1];
		for (let round = 0; round < UNDISTORT_ROUNDS && step > LEAST_STEP && at.offPx > EXACT_PX; round++) {
			const to = placed(at.a + step * (at.next[0] - at.a), at.b + step * (at.next[1] - at.b));
			if (to.offPx < at.offPx) at = to;
			else step /= 2;
		}
		return at.offPx <= MOST_OFF_PX ? [at.a, at.b, 1] : null;
	}

	/**
	 * @param {Look} look
	 * @param {number} width of the picture, which may be smaller than the map
	 * @param {number} height
	 * @returns {{pixels: ImageData, counts: Uint32Array}} the picture, and how often its depths occur from near to far
	 */
	paint({ map, nearM, farM, hatchesNothing, dotsEither }, width, height) {
		const colours = colourTable(map);
		const pixels = new ImageData(width, height);
		const words = new Uint32Array(pixels.data.buffer);
		const counts = new Uint32Array(BINS);
		const columns = Uint32Array.from({ length: width }, (_, x) => Math.floor(((x + 0.5) * this.columns) / width));
		const scale = 1 / Math.log(farM / nearM);
		const logNear = Math.log(nearM);
		for (let y = 0, to = 0; y < height; y++) {
			const row = Math.floor(((y + 0.5) * this.rows) / height) * this.columns;
			for (let x = 0; x < width; x++, to++) {
				const from = row + columns[x];
				const depth = this.depthM[from];
				if (!(depth > 0)) {
					const grey = hatchesNothing && (x + y) % PATTERN_PX < 2 ? HATCH : NOTHING;
					words[to] = 0xff000000 | (grey << 16) | (grey << 8) | grey;
					continue;
				}
				const place = (Math.log(depth) - logNear) * scale;
				if (place >= 0 && place <= 1) counts[Math.min(BINS - 1, Math.floor(place * BINS))]++;
				const colour = 3 * Math.round(255 * (1 - Math.min(1, Math.max(0, place))));
				const isDot = dotsEither && x % PATTERN_PX < 2 && y % PATTERN_PX < 2 && this.isEither(from);
				if (isDot) {
					const isBright = colours[colour] + 2 * colours[colour + 1] + colours[colour + 2] > 480;
					words[to] = isBright ? 0xff000000 : 0xffffffff;
					continue;
				}
				words[to] = 0xff000000 | (colours[colour + 2] << 16) | (colours[colour + 1] << 8) | colours[colour];
			}
		}
		return { pixels, counts };
	}

	/**
	 * Points of evenly spaced pixels, x right, y down, z forward, in metres.
	 *
	 * @param {number} most
	 * @param {Look} look
	 * @param {?ImageData} photograph whose colours the points get; null: those of their depths
	 * @returns {Points} `spacing` is that of
	 *   neighbours at 1 m
	 */
	cloud(most, look, photograph) {
		const step = Math.max(1, Math.sqrt(this.depthM.length / most));
		const [columns, rows] = [Math.floor(this.columns / step), Math.floor(this.rows / step)];
		const [across, down] = [this.width / this.columns, this.height / this.rows];
		const positions = new Float32Array(3 * columns * rows);
		const colours = new Uint8Array(3 * columns * rows);
		const table = colourTable(look.map);
		let count = 0;
		for (let row = 0; row < rows; row++) {
			const v = Math.floor((row + 0.5) * step);
			for (let column = 0; column < columns; column++) {
				const u = Math.floor((column + 0.5) * step);
				const depth = this.depthM[v * this.columns + u];
				if (!(depth > 0)) continue;
				const ray = this.ray((u + 0.5) * across - 0.5, (v + 0.5) * down - 0.5);
				if (ray === null) continue;
				for (let axis = 0; axis < 3; axis++) positions[3 * count + axis] = ray[axis] * depth;
				if (photograph) {
					const x = Math.floor(((u + 0.5) * photograph.width) / this.columns);
					const y = Math.floor(((v + 0.5) * photograph.height) / this.rows);
					const from = 4 * (y * photograph.width + x);
					colours.set(photograph.data.subarray(from, from + 3), 3 * count);
				} else {
					const place = Math.min(1, Math.max(0, placeOf(depth, look.nearM, look.farM)));
					const from = 3 * Math.round(255 * (1 - place));
					colours.set(table.subarray(from, from + 3), 3 * count);
				}
				count++;
			}
		}
		return {
			positions: positions.slice(0, 3 * count),
			colours: colours.slice(0, 3 * count),
			centre: count > 0 ? [0, 1, 2].map((axis) => medianOf(positions, axis, count)) : [0, 0, 1],
			spacing: (step * across) / this.lens.fx,
		};
	}
}

/** How a lens bends a ray. @param {number} x @param {number} y at a depth of 1 @param {number[]} distortion in OpenCV's order */
function bending(x, y, distortion) {
	const [k1 = 0, k2 = 0, p1 = 0, p2 = 0, k3 = 0, k4 = 0, k5 = 0, k6 = 0, s1 = 0, s2 = 0, s3 = 0, s4 = 0] = distortion;
	const r2 = x * x + y * y;
	return {
		stretch: (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6))),
		across: 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2),
		down: p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
	};
}

/** @param {number[]} one @param {number[]} other */
function dot(one, other) {
	return one.reduce((sum, part, axis) => sum + part * other[axis], 0);
}

/** @param {Float32Array} positions @param {number} axis @param {number} count */
function medianOf(positions, axis, count) {
	const step = Math.max(1, Math.floor(count / 5000));
	const sample = Float32Array.from({ length: Math.ceil(count / step) }, (_, at) => positions[3 * at * step + axis]);
	return sample.sort()[sample.length >> 1];
}
