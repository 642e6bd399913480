/** How wide something is shown. */

import { useEffect, useRef, useState } from "./vendor/preact.js";

/** @param {number} first before it is known @returns {[import("preact").RefObject<HTMLElement>, number]} an element to watch, and its width when it was last shown */
export function useWidth(first) {
	const box = useRef(/** @type {?HTMLElement} */ (null));
	const [width, setWidth] = useState(first);
	useEffect(() => {
		const observer = new ResizeObserver(([{ contentRect }]) => {
			if (contentRect.width > 0) setWidth(contentRect.width);
		});
		if (box.current) observer.observe(box.current);
		return () => observer.disconnect();
	}, []);
	return [box, width];
}
