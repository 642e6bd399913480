/** Points in space, drawn by WebGL2 and turned about their middle. */

const VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 colour;
// the same for all points; not uniforms, whose places would be known only when the page has waited for the compiler
layout(location = 2) in float pixelsAtOne;
layout(location = 3) in mat4 toClip;
out vec3 shade;
void main() {
	gl_Position = toClip * vec4(position, 1.0);
	// a point is as large as the pixel it came from is there, so that a surface is closed
	gl_PointSize = clamp(1.5 * pixelsAtOne * position.z / gl_Position.w, 1.0, 16.0);
	shade = colour;
}`;
const FRAGMENT = `#version 300 es
precision mediump float;
in vec3 shade;
out vec4 pixel;
void main() {
	pixel = vec4(shade, 1.0);
}`;

const [POSITION, COLOUR, PIXELS_AT_ONE, TO_CLIP] = [0, 1, 2, 3];
const HALF_VIEW = Math.tan((25 * Math.PI) / 180);
const START = { yaw: 0.22, pitch: -0.14, zoom: 1 };
const STEEPEST = Math.PI / 2;
const ZOOMS = [0.05, 20];

export class Cloud {
	/**
	 * @param {OffscreenCanvas} canvas
	 * @param {WebGL2RenderingContext} gl
	 * @param {(count: number) => void} onDrawn is told how many points were drawn
	 */
	constructor(canvas, gl, onDrawn) {
		this.canvas = canvas;
		this.gl = gl;
		this.onDrawn = onDrawn;
		this.view = { ...START };
		/** @type {?Points} */
		this.points = null;
		this.frame = 0;
		this.setUp();
		canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
		canvas.addEventListener("webglcontextrestored", () => {
			this.setUp();
			if (this.points) this.show(this.points);
		});
	}

	setUp() {
		const { gl } = this;
		const program = /** @type {WebGLProgram} */ (gl.createProgram());
		for (const [kind, text] of /** @type {[number, string][]} */ ([
			[gl.VERTEX_SHADER, VERTEX],
			[gl.FRAGMENT_SHADER, FRAGMENT],
		])) {
			const shader = /** @type {WebGLShader} */ (gl.createShader(kind));
			gl.shaderSource(shader, text);
			gl.compileShader(shader);
			gl.attachShader(program, shader);
		}
		gl.linkProgram(program);
		gl.useProgram(program);
		gl.enable(gl.DEPTH_TEST);
		this.buffers = [gl.createBuffer(), gl.createBuffer()];
	}

	/** @param {number} width of the picture in the screen's pixels @param {number} height */
	resize(width, height) {
		Object.assign(this.canvas, { width, height });
		this.drawSoon();
	}

	/** @param {Points} points */
	show(points) {
		this.points = points;
		this.fill(POSITION, points.positions, this.gl.FLOAT);
		this.fill(COLOUR, points.colours, this.gl.UNSIGNED_BYTE);
		this.drawSoon();
	}

	/** @param {number} place @param {Float32Array | Uint8Array} data @param {number} kind */
	fill(place, data, kind) {
		const { gl } = this;
		gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers?.[place] ?? null);
		gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
		gl.enableVertexAttribArray(place);
		gl.vertexAttribPointer(place, 3, kind, true, 0, 0);
	}

	/** @param {number} right of the picture's height @param {number} down */
	orbit(right, down) {
		this.view.yaw += right * Math.PI;
		this.view.pitch = Math.min(STEEPEST, Math.max(-STEEPEST, this.view.pitch + down * Math.PI));
		this.drawSoon();
	}

	/** @param {number} factor above 1 comes nearer */
	zoom(factor) {
		this.view.zoom = Math.min(ZOOMS[1], Math.max(ZOOMS[0], this.view.zoom * factor));
		this.drawSoon();
	}

	reset() {
		this.view = { ...START };
		this.drawSoon();
	}

	drawSoon() {
		cancelAnimationFrame(this.frame);
		this.frame = requestAnimationFrame(() => this.draw());
	}

	draw() {
		const { gl, canvas, points } = this;
		const { width, height } = canvas;
		if (!points || gl.isContextLost()) return;
		gl.viewport(0, 0, width, height);
		gl.clearColor(0, 0, 0, 0);
		gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
		const matrix = this.matrix(points.centre, width / height);
		for (let column = 0; column < 4; column++) {
			gl.vertexAttrib4fv(TO_CLIP + column, matrix.subarray(4 * column, 4 * column + 4));
		}
		gl.vertexAttrib1f(PIXELS_AT_ONE, (points.spacing * Math.min(width, height)) / (2 * HALF_VIEW));
		gl.drawArrays(gl.POINTS, 0, points.positions.length / 3);
		this.onDrawn(points.positions.length / 3);
	}

	/**
	 * From metres (x right, y down, z forward) to clip space (y up, z towards the viewer), column by column.
	 *
	 * @param {number[]} centre
	 * @param {number} aspect
	 */
	matrix(centre, aspect) {
		const { yaw, pitch, zoom } = this.view;
		const distance = (1.1 * Math.hypot(...centre)) / zoom;
		const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
		// rows of the turn, of a point that has been flipped to y up and z back
		const turn = [
			[cy, 0, -sy],
			[sp * sy, -cp, sp * cy],
			[-cp * sy, -sp, -cp * cy],
		];
		const shift = turn.map((row) => -row.reduce((sum, part, axis) => sum + part * centre[axis], 0));
		shift[2] -= distance;
		const [near, far] = [distance / 100, distance * 100];
		const deep = [(far + near) / (near - far), (2 * far * near) / (near - far)];
		const [across, up] = [1 / (HALF_VIEW * Math.max(aspect, 1)), Math.min(aspect, 1) / HALF_VIEW];
		const columns = [0, 1, 2].flatMap((axis) => [
			across * turn[0][axis],
			up * turn[1][axis],
			deep[0] * turn[2][axis],
			-turn[2][axis],
		]);
		return new Float32Array([...columns, across * shift[0], up * shift[1], deep[0] * shift[2] + deep[1], -shift[2]]);
	}
}
