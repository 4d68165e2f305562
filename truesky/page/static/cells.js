// HEALPix cells of the sky in colours, drawn by WebGL.

import * as api from "/static/api.js";
import { lutTexture, program } from "/static/colour.js";
import { vector } from "/static/sphere.js";

const VERTEX = `in vec3 place; in float value; uniform mat3 turn; uniform vec2 scale; uniform vec2 range; uniform bool linear; out float level;
void main() {
  vec3 v = turn * place;
  float k = sqrt(2.0 / max(1.0 + v.z, 1e-6)) * 57.29577951308232;
  gl_Position = v.z < -0.9 ? vec4(9.0, 9.0, 9.0, 1.0) : vec4(-v.x * k * scale.x, v.y * k * scale.y, 0.0, 1.0);
  level = clamp(((linear ? value : log(value)) - range.x) / max(range.y - range.x, 1e-6), 0.0, 1.0);
}`;
const FRAGMENT = `in float level; uniform sampler2D colours; uniform float alpha; out vec4 colour;
void main() { colour = vec4(texture(colours, vec2(level, 0.5)).rgb, 1.0) * alpha; }`;
// The colour scale covers the cells between these quantiles.
const FIRST = 0.01, LAST = 0.995;

export class Cells {
  constructor(gl, map) {
    Object.assign(this, { gl, parts: program(gl, VERTEX, FRAGMENT), colours: lutTexture(gl, map), buffer: gl.createBuffer() });
  }

  recolour(map) {
    lutTexture(this.gl, map, this.colours);
  }

  /** Load a response of the server; `kind`: "number" for logarithmic colours, "mean" for linear ones, "depth" for linear ones from 0. */
  filled(buffer, kind) {
    const { gl } = this, [head, at] = api.headed(buffer), corners = new Float32Array(buffer, at, head.cells * 8);
    const density = new Float32Array(buffer, at + head.cells * 32, head.cells), data = new Float32Array(head.cells * 24);
    for (let k = 0; k < head.cells; k++) {
      const own = [0, 1, 2, 3].map((c) => vector(corners[8 * k + 2 * c], corners[8 * k + 2 * c + 1]));
      [0, 1, 2, 0, 2, 3].forEach((c, n) => data.set([...own[c], density[k]], 24 * k + 4 * n));
    }
    const linear = kind !== "number", sorted = density.filter((d) => linear || d > 0).sort(), place = (share) => sorted[Math.floor(share * (sorted.length - 1))] ?? 1;
    let range = kind === "depth" ? [0, sorted.at(-1) ?? 1] : [place(FIRST), place(LAST)];
    if (range[0] >= range[1]) range = linear ? [range[0] - 0.5, range[1] + 0.5] : [range[0] / 2, range[1] * 1.01];
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    // Number of rows per square degree in cells that are not empty.
    const rows = (head.rows * 12 * 4 ** (head.order ?? 5)) / (41253 * Math.max(1, density.length));
    return { head, density, corners, count: head.cells * 6, linear, range, rows, beyond: sorted.filter((d) => d < range[0] || d > range[1]).length };
  }

  paint(canvas, cells, turn, scale, alpha) {
    const { gl, parts } = this;
    api.fit(canvas);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!cells?.count) return;
    gl.useProgram(parts);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    for (const [name, size, from] of [["place", 3, 0], ["value", 1, 12]]) {
      const at = gl.getAttribLocation(parts, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, gl.FLOAT, false, 16, from);
    }
    const uniform = (name) => gl.getUniformLocation(parts, name);
    gl.uniformMatrix3fv(uniform("turn"), true, turn);
    gl.uniform2fv(uniform("scale"), scale);
    gl.uniform2fv(uniform("range"), cells.linear ? cells.range : cells.range.map(Math.log));
    gl.uniform1i(uniform("linear"), cells.linear ? 1 : 0);
    gl.uniform1f(uniform("alpha"), alpha);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.colours);
    gl.drawArrays(gl.TRIANGLES, 0, cells.count);
  }
}
