// Cache of image tiles as WebGL textures; the tile that was not used for longest is deleted first.

import * as api from "/static/api.js";

// Largest number of tiles, each 1 MB.
const MOST = 120;

export class Tiles {
  /** redraw: called when a tile has arrived. */
  constructor(gl, redraw) {
    Object.assign(this, { gl, redraw, kept: new Map() });
  }

  /** A tile, whose texture may still be loading. */
  get(image, level, row, column, mended) {
    const name = [image.number, mended, level, row, column].join("/"), known = this.kept.get(name);
    if (known) {
      this.kept.delete(name);
      this.kept.set(name, known);
      return known;
    }
    const width = Math.min(image.tile, image.levels[level][0] - column * image.tile);
    const height = Math.min(image.tile, image.levels[level][1] - row * image.tile);
    const made = { width, height, texture: null, data: null };
    this.kept.set(name, made);
    api.bytes(`tile/${image.number}/${level}/${row}/${column}${mended ? "?mended=1" : ""}`).then((buffer) => {
      // Ignore a tile that was deleted while it was loading, because nothing would delete its texture.
      if (this.kept.get(name) === made) this.fill(made, buffer);
    }, (error) => {
      if (this.kept.get(name) === made) this.kept.delete(name);
      api.say(error.message, true);
    });
    for (const [old, value] of this.kept) {
      if (this.kept.size <= MOST) break;
      if (value.texture) this.gl.deleteTexture(value.texture);
      this.kept.delete(old);
    }
    return made;
  }

  fill(made, buffer) {
    const gl = this.gl;
    made.data = new Float32Array(buffer);
    made.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, made.width, made.height, 0, gl.RED, gl.FLOAT, made.data);
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
    for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
    this.redraw();
  }

  /** Value of a pixel in the finest loaded level; null if no level is loaded. */
  value(image, x, y, mended) {
    for (let level = 0; level < image.levels.length; level++) {
      const u = Math.floor(x / 2 ** level), v = Math.floor(y / 2 ** level);
      const found = this.kept.get([image.number, mended, level, Math.floor(v / image.tile), Math.floor(u / image.tile)].join("/"));
      if (found?.data) return { level, value: found.data[(v % image.tile) * found.width + (u % image.tile)] };
    }
    return null;
  }
}
