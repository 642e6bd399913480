/** Give a person a file, as a download. @param {Blob} blob @param {string} name */
export function save(blob, name) {
	const link = document.createElement("a");
	link.href = URL.createObjectURL(blob);
	link.download = name;
	link.click();
	// not at once: the browser may not have begun to read it
	setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
