/** The request behind a picture, as something to paste. */

export const FORMATS = {
	png: "PNG, 16-bit millimetres",
	npy: "NumPy, metres",
	npz: "NumPy, all maps",
	tiff: "TIFF, float metres",
	ply: "PLY, coloured points",
	preview: "JPEG, for the eye",
	json: "JSON, summary",
};

/** @param {Ask} ask @returns {string} path and query, relative to the page */
export function depthPath({ camera, side, focusM, known, format }) {
	const query = new URLSearchParams({ camera });
	if (side !== "auto") query.set("side", side);
	if (focusM !== null) query.set("focus_distance_m", String(focusM));
	for (const { u, v, depthM } of known) query.append("known", `${u},${v},${Number(depthM.toPrecision(9))}`);
	query.set("format", format);
	return `depth?${query}`;
}

/** @param {string} photograph the file's name @param {string} format */
export function answerName(photograph, format) {
	return `${photograph.replace(/\.[^.]*$/, "") || "photograph"}-depth.${format === "preview" ? "jpg" : format}`;
}

/** @param {Command} command the key itself is never in it, but the shell's variable for it */
export function curlCommand({ url, photograph, mediaType, answer, hasKey }) {
	return [
		`curl --fail-with-body ${quoted(url)}`,
		...(hasKey ? ['  -H "Authorization: Bearer $CAMIND_API_KEY"'] : []),
		`  -H ${quoted(`Content-Type: ${mediaType}`)}`,
		`  --data-binary ${quoted(`@${photograph}`)} -o ${quoted(answer)}`,
	].join(" \\\n");
}

/** @param {Command} command runs with the standard library alone */
export function pythonCommand({ url, photograph, mediaType, answer, hasKey }) {
	const headers = [`"Content-Type": ${JSON.stringify(mediaType)}`];
	if (hasKey) headers.push('"Authorization": "Bearer " + os.environ["CAMIND_API_KEY"]');
	return `${hasKey ? "import os\n" : ""}from pathlib import Path
from urllib.request import Request, urlopen

request = Request(
    ${JSON.stringify(url)},
    data=Path(${JSON.stringify(photograph)}).read_bytes(),
    headers={${headers.join(", ")}},
)
with urlopen(request) as answer:
    print(answer.headers["Camind-Warnings"])
    Path(${JSON.stringify(answer)}).write_bytes(answer.read())
`;
}

/** @param {string} text as one word of a POSIX shell */
function quoted(text) {
	return `'${text.replaceAll("'", "'\\''")}'`;
}
