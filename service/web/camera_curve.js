/** What a camera's numbers come to: k_cam, its range, and blur against distance. */

import { Chart } from "./chart.js";
import { short } from "./numbers.js";
import { html } from "./vendor/preact.js";

/** @param {{camera: any, points: any[] | null}} props `camera` as the API reads or previews it */
export function CameraCurve({ camera, points }) {
	const { far } = camera.range_m;
	return html`
		<dl class="figures">
			<div><dt>k_cam</dt><dd>${short(camera.k_cam_px, 4)} <small>px</small></dd></div>
			<div><dt>Usable range</dt><dd>up to ${short(far)} <small>m</small></dd></div>
			<div><dt>Focal length</dt><dd>${short(camera.fx_px, 4)} <small>px</small></dd></div>
		</dl>
		<p class="hint">Up to ${short(far)} m, a blur read wrong by 0.25 px moves the depth by less than 10 %.</p>
		${points &&
		html`<${Chart}
			title="Blur against distance"
			x=${{ label: "distance", unit: "m", isLog: true }}
			y=${{ label: "blur", unit: "px", from: 0 }}
			marks=${[
				{ x: camera.focus_distance_m, label: "in focus" },
				...(far < points[points.length - 1].depth_m && far > points[0].depth_m ? [{ x: far, label: "range ends" }] : []),
			]}
			series=${[
				{ name: "", kind: "line", tone: "one", points: points.map((point) => ({ x: point.depth_m, y: point.blur_px })) },
			]}
		/>`}
	`;
}
