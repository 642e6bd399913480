/** Reads NumPy's npz: a zip of npy files, stored and not compressed. */

const END_OF_DIRECTORY = 0x06054b50;
const END_BYTES = 22;
const DIRECTORY_ENTRY_BYTES = 46;
const LOCAL_HEADER_BYTES = 30;
const MAGIC_BYTES = 10;
/** @type {Record<string, Float32ArrayConstructor | Float64ArrayConstructor | Uint8ArrayConstructor>} */
const KINDS = { "<f4": Float32Array, "<f8": Float64Array, "|b1": Uint8Array };

/** @param {Blob} file @returns {Promise<{arrays: Map<string, NumpyArray>, comment: string}>} arrays by their names, and the zip's comment */
export async function readNpz(file) {
	const buffer = await file.arrayBuffer();
	const zip = new DataView(buffer);
	let end = zip.byteLength - END_BYTES;
	while (end >= 0 && zip.getUint32(end, true) !== END_OF_DIRECTORY) end--;
	if (end < 0) throw new Error("This is no whole npz.");
	const count = zip.getUint16(end + 10, true);
	const arrays = new Map();
	for (let entry = 0, at = zip.getUint32(end + 16, true); entry < count; entry++) {
		const lengths = [28, 30, 32].map((place) => zip.getUint16(at + place, true));
		const name = textOf(zip, at + DIRECTORY_ENTRY_BYTES, lengths[0]);
		const [bytes, local] = [zip.getUint32(at + 24, true), zip.getUint32(at + 42, true)];
		if (zip.getUint16(at + 10, true) !== 0) throw new Error("A compressed npz cannot be read.");
		const start = local + LOCAL_HEADER_BYTES + zip.getUint16(local + 26, true) + zip.getUint16(local + 28, true);
		arrays.set(name.replace(/\.npy$/, ""), readNpy(buffer.slice(start, start + bytes)));
		at += DIRECTORY_ENTRY_BYTES + lengths[0] + lengths[1] + lengths[2];
	}
	return { arrays, comment: textOf(zip, end + END_BYTES, zip.getUint16(end + 20, true)) };
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
