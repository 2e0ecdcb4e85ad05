// The geometry of image-matching curves: lines of sight of one view, as another view shows them. No page, no drawing.
//
// A `Sight` is the compact map of a calibrated view (sight.py). Its curves agree with the server's to 0.05 px (tests).

/** @typedef {[number, number]} Pair pixels (u, v), or mm on a plane */
/** @typedef {{ start: Pair, step: Pair, count: number, values: (Pair | null)[] }} GridDocument */
/**
 * @typedef {{ focal: number[], origin: number[], axes: number[][], toPlane: GridDocument, toImage: GridDocument,
 *   sides: number[][], reach: number }} SightDocument
 */
/** @typedef {{ depth: number[], uv: Pair[] }} Curve samples: depth in mm from the first view's plane, and pixels */

export const STEP_MM = 2; // as on the server (curve.py)
const TICK_MM = 10;
const FROM_ENDS = 0.5; // samples: a slid point stays that far from the curve's ends, so that the server takes it

/** @type {(a: number[], b: number[]) => number} */
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @type {(a: number[], b: number[]) => number[]} */
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** @type {(a: number[], b: number[], t: number) => number[]} */
const along = (a, b, t) => [a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]];

/** Weights of the four nodes about a place `t` (0 to 1) between the second and the third: cubic convolution (Keys 1981).
 * @type {(t: number) => number[]} */
const cubic = (t) => [
  ((2 - t) * t - 1) * t * 0.5,
  ((3 * t - 5) * t * t + 2) * 0.5,
  ((4 - 3 * t) * t + 1) * t * 0.5,
  (t - 1) * t * t * 0.5,
];

/** The value of a grid at (x, y); null outside, and where a node is missing.
 * @type {(grid: GridDocument, at: Pair) => Pair | null} */
export function interpolated({ start, step, count, values }, [x, y]) {
  const [across, down] = [(x - start[0]) / step[0], (y - start[1]) / step[1]];
  const [column, row] = [Math.floor(across), Math.floor(down)];
  if (!(column >= 1 && row >= 1 && column < count - 2 && row < count - 2)) return null;
  const [byColumn, byRow] = [cubic(across - column), cubic(down - row)];
  let [a, b] = [0, 0];
  for (let j = 0; j < 4; j++) {
    for (let i = 0; i < 4; i++) {
      const node = values[(row - 1 + j) * count + column - 1 + i];
      if (node === null) return null;
      const weight = byRow[j] * byColumn[i];
      a += weight * node[0];
      b += weight * node[1];
    }
  }
  return [a, b];
}

export class Sight {
  /** @param {SightDocument} document */
  constructor(document) {
    this.document = document;
    const [a, b] = document.axes;
    this.normal = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  }

  /** The point of a pixel's line of sight on the reference plane; null where the view is not calibrated.
   * @param {Pair} uv */
  pierced(uv) {
    const { origin, axes, toPlane } = this.document;
    const xy = this.isNear(uv) ? interpolated(toPlane, uv) : null;
    return xy && along(along(origin, axes[0], xy[0]), axes[1], xy[1]);
  }

  /** The pixel of a point; null where the view is not calibrated.
   * @param {number[]} point */
  projected(point) {
    const { focal, origin, axes, toImage } = this.document;
    const ahead = 1 - dot(minus(point, origin), this.normal) / dot(minus(focal, origin), this.normal);
    if (!(ahead > 0)) return null;
    const shadow = minus(along(focal, minus(point, focal), 1 / ahead), origin);
    const uv = interpolated(toImage, [dot(shadow, axes[0]), dot(shadow, axes[1])]);
    return uv && this.isNear(uv) ? uv : null;
  }

  /** Whether the map is valid at a pixel.
   * @param {Pair} uv */
  isNear([u, v]) {
    return this.document.sides.every(([a, b, offset]) => a * u + b * v + offset <= this.document.reach);
  }
}

/** The line of sight of a pixel of one view in another, where that is calibrated: of several stretches the one nearest
 * to the foot of the line, its point nearest to the other focal point. Null without one.
 * @type {(from: Sight, uv: Pair, to: Sight) => Curve | null} */
export function matchingCurve(from, uv, to) {
  const point = from.pierced(uv);
  if (!point) return null;
  const ray = minus(from.document.focal, point);
  const length = Math.sqrt(dot(ray, ray));
  const count = Math.floor(length / STEP_MM);
  const foot = dot(minus(to.document.focal, point), ray) / length;
  let [best, least, open] = [/** @type {Curve | null} */ (null), Infinity, /** @type {Curve | null} */ (null)];
  for (let k = -count; k <= count; k++) {
    const depth = k * STEP_MM;
    const seen = k < count ? to.projected(along(point, ray, depth / length)) : null;
    if (seen) {
      open ??= { depth: [], uv: [] };
      open.depth.push(depth);
      open.uv.push(seen);
    } else if (open) {
      const away = Math.max(open.depth[0] - foot, foot - /** @type {number} */ (open.depth.at(-1)), 0);
      if (away < least && open.uv.length > 2) [best, least] = [open, away];
      open = null;
    }
  }
  return best;
}

/** Where a curve is nearest to a pixel, as an index between its samples.
 * @type {(curve: Curve, uv: Pair) => number} */
export function nearest({ uv }, [x, y]) {
  let [best, least] = [0, Infinity];
  for (let k = 0; k + 1 < uv.length; k++) {
    const [[u0, v0], [u1, v1]] = [uv[k], uv[k + 1]];
    const [du, dv] = [u1 - u0, v1 - v0];
    const share = Math.min(Math.max(((x - u0) * du + (y - v0) * dv) / (du * du + dv * dv || 1), 0), 1);
    const away = Math.hypot(u0 + share * du - x, v0 + share * dv - y);
    if (away < least) [best, least] = [k + share, away];
  }
  return best;
}

/** @type {(values: number[], at: number) => number} */
const between = (values, at) => {
  const k = Math.min(Math.floor(at), values.length - 2);
  return values[k] + (at - k) * (values[k + 1] - values[k]);
};

/** The pixel at an index between samples, not quite at an end.
 * @type {(curve: Curve, at: number) => Pair} */
export function pixelAt({ uv }, at) {
  const held = Math.min(Math.max(at, FROM_ENDS), uv.length - 1 - FROM_ENDS);
  return [between(uv.map(([u]) => u), held), between(uv.map(([, v]) => v), held)];
}

/** The depth, mm, at which a curve is nearest to a pixel.
 * @type {(curve: Curve, uv: Pair) => number} */
export const depthAt = (curve, uv) => between(curve.depth, nearest(curve, uv));

/** The pixel at a depth, at an end of the curve where it does not reach that.
 * @type {(curve: Curve, depth: number) => Pair} */
export const pixelAtDepth = (curve, depth) => pixelAt(curve, (depth - curve.depth[0]) / STEP_MM);

/** The shapes of a curve, as shapes.py has them. `widths`: the band's half width by depth; null: unknown.
 * @type {(curve: Curve, of: string, title: string, widths: ((depth: number) => number) | null) => import("./types").Shape[]} */
export function curveShapes({ depth, uv }, of, title, widths) {
  const ticks = depth.map((_, k) => k).filter((k) => depth[k] % TICK_MM === 0);
  const label = ticks.map((k) => (depth[k] % (5 * TICK_MM) === 0 ? String(depth[k]) : ""));
  const shapes = [
    { shape: "line", of, points: uv, style: "curve", title },
    { shape: "ticks", of, points: ticks.map((k) => uv[k]), style: "tick", label },
  ];
  return widths ? [{ shape: "band", of, points: uv, halfWidth: depth.map(widths), style: "curve-band" }, ...shapes] : shapes;
}
