/** Focus that goes with its element is given to what one reaches before, or to the tab in front where its view has gone. */

const STOPS = "a, button, input, select, summary, [tabindex='0']";
const WAIT_MS = 100; // the page goes first

/** @type {any} */
let last = null;
/** @type {any[]} */
let reached = [];

document.addEventListener("focusin", ({ target }) => {
	last = target;
	const all = [...(last.closest("main > section")?.querySelectorAll(STOPS) ?? [])];
	reached = all.slice(0, all.indexOf(last) + 1);
});

new MutationObserver(() => setTimeout(keep, WAIT_MS)).observe(document, { childList: true, subtree: true });

function keep() {
	if (document.activeElement !== document.body || !last || last.checkVisibility()) return;
	const tab = document.querySelector("nav [tabindex='0']");
	[tab, ...reached].findLast((one) => one.checkVisibility() && !one.disabled)?.focus({ preventScroll: true });
}
