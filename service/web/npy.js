/** Reads NumPy's npz: a zip of npy files, stored and not compressed. */

/** @typedef {{data: Float32Array | Float64Array | Uint8Array, shape: number[]}} NumpyArray */

const END_OF_DIRECTORY = 0x06054b50;
const END_BYTES = 22;
const MOST_COMMENT_BYTES = 65535;
const DIRECTORY_ENTRY_BYTES = 46;
const LOCAL_HEADER_BYTES = 30;
const MAGIC_BYTES = 10;
/** @type {Record<string, Float32ArrayConstructor | Float64ArrayConstructor | Uint8ArrayConstructor>} */
const KINDS = { "<f4": Float32Array, "<f8": Float64Array, "|b1": Uint8Array };

/**
 * Only one array is in memory twice at a time, and the zip itself never.
 *
 * @param {Blob} file
 * @returns {Promise<Map<string, NumpyArray>>} arrays by their names
 */
export async function readNpz(file) {
	const last = new DataView(await file.slice(-END_BYTES - MOST_COMMENT_BYTES).arrayBuffer());
	let end = last.byteLength - END_BYTES;
	while (end >= 0 && last.getUint32(end, true) !== END_OF_DIRECTORY) end--;
	if (end < 0) throw new Error("This is no whole npz.");
	const count = last.getUint16(end + 10, true);
	const [directoryBytes, start] = [12, 16].map((place) => last.getUint32(end + place, true));
	const directory = new DataView(await file.slice(start, start + directoryBytes).arrayBuffer());
	const arrays = new Map();
	for (let entry = 0, at = 0; entry < count; entry++) {
		const lengths = [28, 30, 32].map((place) => directory.getUint16(at + place, true));
		const name = textOf(directory, at + DIRECTORY_ENTRY_BYTES, lengths[0]);
		const [bytes, header] = [directory.getUint32(at + 24, true), directory.getUint32(at + 42, true)];
		if (directory.getUint16(at + 10, true) !== 0) throw new Error("A compressed npz cannot be read.");
		arrays.set(name.replace(/\.npy$/, ""), await readEntry(file, header, bytes));
		at += DIRECTORY_ENTRY_BYTES + lengths[0] + lengths[1] + lengths[2];
	}
	return arrays;
}

/** @param {Blob} file @param {number} header where the entry's own header begins @param {number} bytes */
async function readEntry(file, header, bytes) {
	const local = new DataView(await file.slice(header, header + LOCAL_HEADER_BYTES).arrayBuffer());
	const start = header + LOCAL_HEADER_BYTES + local.getUint16(26, true) + local.getUint16(28, true);
	return readNpy(await file.slice(start, start + bytes).arrayBuffer());
}

/** @param {ArrayBuffer} buffer @returns {NumpyArray} */
function readNpy(buffer) {
	const view = new DataView(buffer);
	if (textOf(view, 1, 6) !== "NUMPY\x01") throw new Error("This is no npy of version 1.");
	const length = view.getUint16(8, true);
	const header = textOf(view, MAGIC_BYTES, length);
	const kind = /'descr': '([^']+)'/.exec(header)?.[1] ?? "";
	const sizes = /'shape': \(([^)]*)\)/.exec(header)?.[1] ?? "";
	if (!(kind in KINDS) || !header.includes("'fortran_order': False")) throw new Error(`npy of ${kind} cannot be read.`);
	// NumPy pads the header so that the numbers begin at a multiple of 64 bytes
	return { data: new KINDS[kind](buffer, MAGIC_BYTES + length), shape: (sizes.match(/\d+/g) ?? []).map(Number) };
}

/** @param {DataView} view @param {number} start @param {number} length */
function textOf(view, start, length) {
	return new TextDecoder("latin1").decode(new Uint8Array(view.buffer, view.byteOffset + start, length));
}
