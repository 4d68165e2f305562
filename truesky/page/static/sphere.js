// Positions on the sphere: the equal-area projection of the map, and the tangent planes of images.

export const RAD = Math.PI / 180;

/** Matrix that rotates unit vectors so that a centre becomes [0, 0, 1]; its rows point east, north and outwards. */
export function frame(ra, dec) {
  const a = ra * RAD, d = dec * RAD;
  return [-Math.sin(a), Math.cos(a), 0, -Math.sin(d) * Math.cos(a), -Math.sin(d) * Math.sin(a), Math.cos(d),
    Math.cos(d) * Math.cos(a), Math.cos(d) * Math.sin(a), Math.sin(d)];
}

export function vector(ra, dec) {
  const a = ra * RAD, d = dec * RAD;
  return [Math.cos(d) * Math.cos(a), Math.cos(d) * Math.sin(a), Math.sin(d)];
}

/** Map coordinates (deg near the centre) of a position; null beyond the edge of the sphere. */
export function project(turn, ra, dec) {
  const v = vector(ra, dec), x = turn[0] * v[0] + turn[1] * v[1] + turn[2] * v[2];
  const y = turn[3] * v[0] + turn[4] * v[1] + turn[5] * v[2], z = turn[6] * v[0] + turn[7] * v[1] + turn[8] * v[2];
  if (z < -0.98) return null;
  const scale = Math.sqrt(2 / (1 + z)) / RAD;
  return [-x * scale, y * scale];
}

/** Position of map coordinates; null outside the sky. */
export function unproject(turn, mapX, mapY) {
  const x = -mapX * RAD, y = mapY * RAD, r2 = x * x + y * y;
  if (r2 > 4) return null;
  const z = 1 - r2 / 2, k = Math.sqrt(1 - r2 / 4), e = x * k, n = y * k;
  const v = [0, 1, 2].map((i) => e * turn[i] + n * turn[3 + i] + z * turn[6 + i]);
  return [((Math.atan2(v[1], v[0]) / RAD) + 360) % 360, Math.asin(Math.max(-1, Math.min(1, v[2]))) / RAD];
}

/** RA and Dec (deg) of a text in degrees or sexagesimal; null for any other text. */
export function placeOf(text) {
  const numbers = text.match(/[-+−]?\d+(\.\d+)?/g)?.map((t) => Number(t.replace("−", "-"))) ?? [];
  if (numbers.length === 6 && /:/.test(text)) {
    const [h, m, s, d, n, t] = numbers, sign = /[-−]\s*\d/.test(text) ? -1 : 1;
    numbers.splice(0, 6, 15 * (h + m / 60 + s / 3600), sign * (Math.abs(d) + n / 60 + t / 3600));
  }
  return numbers.length === 2 && Math.abs(numbers[1]) <= 90 ? [((numbers[0] % 360) + 360) % 360, numbers[1]] : null;
}

/** The circle (deg) around the mean of positions [ra, dec, ra, dec ...] that contains all these positions. */
export function circleAround(corners) {
  const places = [];
  for (let k = 0; k < corners.length; k += 2) places.push(vector(corners[k], corners[k + 1]));
  const sum = [0, 1, 2].map((i) => places.reduce((all, v) => all + v[i], 0)), size = Math.hypot(...sum) || 1, mean = sum.map((s) => s / size);
  const least = places.reduce((low, v) => Math.min(low, v[0] * mean[0] + v[1] * mean[1] + v[2] * mean[2]), 1);
  return { ra: (Math.atan2(mean[1], mean[0]) / RAD + 360) % 360, dec: Math.asin(mean[2]) / RAD, radius: Math.acos(Math.max(-1, least)) / RAD };
}

/** Conversion between pixels and sky of an image, from the nodes of its grid. */
export class Plate {
  constructor(grid) {
    Object.assign(this, grid);
    this.n = grid.x.length;
    this.step = [(grid.x.at(-1) - grid.x[0]) / (this.n - 1), (grid.y.at(-1) - grid.y[0]) / (this.n - 1)];
    this.turn = frame(grid.ra, grid.dec);
  }

  /** Tangent-plane coordinates (deg) of a pixel, extrapolated beyond the edge. */
  plane(x, y) {
    const u = (x - this.x[0]) / this.step[0], v = (y - this.y[0]) / this.step[1];
    const i = Math.max(0, Math.min(this.n - 2, Math.floor(u))), j = Math.max(0, Math.min(this.n - 2, Math.floor(v)));
    const a = u - i, b = v - j, k = j * this.n + i;
    const at = (t) => (1 - b) * ((1 - a) * t[k] + a * t[k + 1]) + b * ((1 - a) * t[k + this.n] + a * t[k + this.n + 1]);
    return [at(this.xi), at(this.eta)];
  }

  sky(x, y) {
    const [xi, eta] = this.plane(x, y).map((value) => value * RAD), t = this.turn, norm = Math.hypot(1, xi, eta);
    const v = [0, 1, 2].map((i) => (xi * t[i] + eta * t[3 + i] + t[6 + i]) / norm);
    return [((Math.atan2(v[1], v[0]) / RAD) + 360) % 360, Math.asin(v[2]) / RAD];
  }

  pixel(ra, dec) {
    const v = vector(ra, dec), t = this.turn, dot = (k) => t[k] * v[0] + t[k + 1] * v[1] + t[k + 2] * v[2];
    const out = dot(6), xi = dot(0) / out / RAD, eta = dot(3) / out / RAD;
    if (out <= 0) return null;
    let x = (this.x[0] + this.x.at(-1)) / 2, y = (this.y[0] + this.y.at(-1)) / 2;
    for (let round = 0; round < 12; round++) {
      const [a, b] = this.plane(x, y), [ax, bx] = this.plane(x + 1, y), [ay, by] = this.plane(x, y + 1);
      const j = [ax - a, ay - a, bx - b, by - b], det = j[0] * j[3] - j[1] * j[2], e = xi - a, n = eta - b;
      const dx = (e * j[3] - n * j[1]) / det, dy = (n * j[0] - e * j[2]) / det;
      x += dx;
      y += dy;
      if (Math.abs(dx) + Math.abs(dy) < 1e-5) break;
    }
    return [x, y];
  }
}
