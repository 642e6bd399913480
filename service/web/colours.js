/** Colour maps as tables of 256 colours, from a few stops each. Near is the end of a table, far its beginning. */

// matplotlib's maps (CC0) at even steps; what lies between is off by 7 of 255 at most
const STOPS = {
	cividis: "00224e00285b002e6a0433711a386f273e6e32436d3b496c434e6c4b546c52596d5a5f6e61656f686a716f70737576767c7b788481798b8778938d789b9376a39a75aba072b3a670bbad6cc3b469ccba64d4c15fddc958e6d051efd748f8df3cfee838",
	viridis: "44015448186a472d7b4240863b528b33638d2c728e26818e21908c1f9f8828ae803ebc745dc96382d34cabdc32d5e21afde725",
	turbo: "30123b3c3183434fbb466be34686fa3ba1fd29bbec1ad2d11ae4b631f29956fb7580ff54a3fd3cbff434d8e436edd03afaba39fe9f2ffb8022f26114e4460bd23105ba1f029d10017a0403",
	grey: "141414ffffff",
};
const LEVELS = 256;

/** @type {[MapName, string][]} the first one is told apart by every kind of colour vision */
export const MAPS = [
	["cividis", "Cividis"],
	["viridis", "Viridis"],
	["turbo", "Turbo"],
	["grey", "Grey"],
];

/** @param {MapName} name @returns {Uint8ClampedArray} 256 times red, green, blue */
export function colourTable(name) {
	const stops = (STOPS[name].match(/../g) ?? []).map((digits) => parseInt(digits, 16));
	const last = stops.length / 3 - 1;
	const table = new Uint8ClampedArray(3 * LEVELS);
	for (let level = 0; level < LEVELS; level++) {
		const place = (level / (LEVELS - 1)) * last;
		const before = Math.min(Math.floor(place), last - 1);
		for (let channel = 0; channel < 3; channel++) {
			const [low, high] = [stops[3 * before + channel], stops[3 * (before + 1) + channel]];
			table[3 * level + channel] = low + (high - low) * (place - before);
		}
	}
	return table;
}

/**
 * The place of a depth between two others, on a logarithm: an error of blur is a share of the depth.
 *
 * @param {number} depthM
 * @param {number} nearM
 * @param {number} farM
 * @returns {number} 0 at the nearest, 1 at the farthest, not bounded
 */
export function placeOf(depthM, nearM, farM) {
	return Math.log(depthM / nearM) / Math.log(farM / nearM);
}
