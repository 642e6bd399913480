/** What a camera's numbers come to: k_cam, its range, and blur against distance. */

import { usableM } from "./camera_specs.js";
import { Chart } from "./chart.js";
import { short } from "./numbers.js";
import { html } from "./vendor/preact.js";

/** @param {{camera: any, points: any[] | null}} props `camera` as the API reads or previews it */
export function CameraCurve({ camera, points }) {
	const range = usableM(camera);
	return html`
		<dl class="figures">
			<div><dt>k_cam</dt><dd>${short(camera.k_cam_px, 4)} <small>px</small></dd></div>
			<div><dt>Usable range</dt><dd>${range ? html`${short(range[0])} to ${short(range[1])} <small>m</small>` : "none"}</dd></div>
			<div><dt>Focal length</dt><dd>${short(camera.fx_px, 4)} <small>px</small></dd></div>
		</dl>
		<p class="hint">
			${range ? "Within it" : "Nowhere"} a blur read wrong by 0.25 px moves the depth by less than 10 %.
		</p>
		${points &&
		html`<${Chart}
			title="Blur against distance"
			x=${{ label: "distance", unit: "m", isLog: true }}
			y=${{ label: "blur", unit: "px", from: 0 }}
			marks=${[
				{ x: camera.focus_distance_m, label: "in focus" },
				{ x: range?.[1] ?? 0, label: "range ends" },
			].filter(({ x }) => x < points.at(-1).depth_m && x > points[0].depth_m)}
			series=${[
				{ name: "", kind: "line", tone: "one", points: points.map((point) => ({ x: point.depth_m, y: point.blur_px })) },
			]}
		/>`}
	`;
}
