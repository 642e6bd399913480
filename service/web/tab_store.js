/** What a tab keeps while it is loaded again, as a phone does with one that was long away. */

/** @param {string} name @returns {?string} */
export function kept(name) {
	try {
		return sessionStorage.getItem(name);
	} catch {
		return null; // a browser that stores nothing for a page still shows it
	}
}

/** @param {string} name @param {?string} text null: it is forgotten */
export function keep(name, text) {
	try {
		if (text === null) sessionStorage.removeItem(name);
		else sessionStorage.setItem(name, text);
	} catch {
		// it is there until the page is left
	}
}
