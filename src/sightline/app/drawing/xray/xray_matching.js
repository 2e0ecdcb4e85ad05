// Image-matching curves in one view of points that move in another: drawn at once from the maps of both views.
//
// They are provisional like the move itself: once the server has acknowledged it, its own curves are shown.

import { curveShapes, depthAt, matchingCurve, nearest, pixelAt, pixelAtDepth, Sight, STEP_MM } from "./xray_sight.js";

/** @typedef {import("./xray_sight.js").Pair} Pair */
/** @typedef {import("./xray_sight.js").Curve} Curve */
/** @typedef {import("./types").Shape} Shape */
/** @typedef {import("./types").Matching} Word */
/** @typedef {import("./xray.js").XrayCore} XrayCore */

/** @type {Map<string, Promise<Sight>>} */
const sights = new Map(); // by address, of all views of the page

/** @type {(address: string) => Promise<Sight>} */
function fetched(address) {
  const known = sights.get(address);
  if (known) return known;
  const coming = fetch(address)
    .then((answer) => (answer.ok ? answer.json() : Promise.reject(new Error(`map: HTTP ${answer.status}`))))
    .then((document) => new Sight(document));
  coming.catch(() => sights.delete(address)); // so that the next message asks again
  sights.set(address, coming);
  return coming;
}

export class Matching {
  constructor() {
    /** @type {Word | null} */
    this.word = null;
    /** @type {Sight[] | null} */
    this.sights = null;
    /** @type {Map<string, { uv: Pair, curve: Curve | null }>} */
    this.drawn = new Map(); // by point
    /** @type {Map<string, number>} */
    this.depths = new Map(); // of points that slide while another view moves them
    /** @type {Map<string, (depth: number) => number>} */
    this.widths = new Map(); // half widths of the newest band
  }

  /** The content of the newest message. `report(message)` hears of a map that cannot be loaded.
   * @param {Word | null} word
   * @param {Iterable<Shape>} shapes
   * @param {(message: string) => void} report */
  show(word, shapes, report) {
    for (const { of, shape, halfWidth, from } of shapes) {
      if (of === undefined || shape !== "band" || !Array.isArray(halfWidth) || from === undefined) continue;
      this.widths.set(of, (depth) => {
        const at = Math.round((depth - from) / STEP_MM);
        return halfWidth[Math.min(Math.max(at, 0), halfWidth.length - 1)];
      });
    }
    if (JSON.stringify(word) === JSON.stringify(this.word)) return;
    this.word = word;
    this.sights = null;
    this.drawn.clear();
    if (word === null) return;
    Promise.all(word.sights.map(fetched)).then(
      (both) => {
        if (this.word === word) this.sights = both;
      },
      (error) => report(String(error.message || error)),
    );
  }

  /** The curve of a point at `uv` in the other view; null where there is none, or no map yet.
   * @param {string} id
   * @param {Pair} uv
   * @returns {Curve | null} */
  curve(id, uv) {
    if (!this.sights) return null;
    const known = this.drawn.get(id);
    if (known && known.uv[0] === uv[0] && known.uv[1] === uv[1]) return known.curve;
    const curve = matchingCurve(this.sights[0], uv, this.sights[1]);
    this.drawn.set(id, { uv: [uv[0], uv[1]], curve });
    return curve;
  }

  /** The shapes, with those of the points `moving` (id to place in the other view) replaced; left out before the maps
   * have arrived.
   * @param {Shape[]} shapes
   * @param {Map<string, Pair>} moving
   * @returns {Shape[]} */
  over(shapes, moving) {
    const { word } = this;
    if (!word || moving.size === 0) return shapes;
    const own = [...moving].flatMap(([id, uv]) => {
      const curve = this.curve(id, uv);
      return curve ? curveShapes(curve, id, word.title.replace("{name}", word.names?.[id] ?? id), this.widths.get(id) || null) : [];
    });
    return [...own, ...shapes.filter(({ of }) => of === undefined || !moving.has(of))];
  }

  /** The place on the curve of `other` (in the other view) that is nearest to `uv`; `uv` itself without a curve.
   * @param {string} id
   * @param {Pair | null} other
   * @param {Pair} uv
   * @returns {Pair} */
  onCurve(id, other, uv) {
    const curve = other && this.curve(id, other);
    return curve ? pixelAt(curve, nearest(curve, uv)) : uv;
  }

  /** Where a point at `uv` on the curve of `before` slides as its place in the other view moves to `after`: to the same
   * depth.
   * @param {string} id
   * @param {Pair} uv
   * @param {Pair} before
   * @param {Pair} after
   * @returns {Pair} */
  slid(id, uv, before, after) {
    if (!this.depths.has(id)) {
      const curve = this.curve(id, before);
      if (!curve) return uv;
      this.depths.set(id, depthAt(curve, uv));
    }
    const curve = this.curve(id, after);
    return curve ? pixelAtDepth(curve, /** @type {number} */ (this.depths.get(id))) : uv;
  }

  /** The point no longer moves.
   * @param {string} id */
  rest(id) {
    this.depths.delete(id);
  }
}

// Points of one view that move with those of another: on their image-matching curves.
export class Following {
  /** @param {XrayCore} core */
  constructor(core) {
    this.core = core;
  }

  /** The view whose points' curves are drawn here; null: none. */
  get leader() {
    const { word } = this.core.matching;
    return (word && window.sightlineXray[word.from]) || null;
  }

  /** The views that draw the curves of this view's points.
   * @returns {Following[]} */
  get followers() {
    const views = Object.values(window.sightlineXray);
    return views.filter(({ matching }) => matching.word?.from === this.core.name).map(({ following }) => following);
  }

  /** Points that the person moves in the other view, and where they are there.
   * @returns {Map<string, Pair>} */
  get moving() {
    return this.leader ? this.leader.edits.moved : new Map();
  }

  /** The place on the point's image-matching curve nearest to `uv`; `uv` itself where it has none.
   * @param {string} id
   * @param {Pair} uv */
  slid(id, uv) {
    const point = this.leader?.point(id);
    return this.core.matching.onCurve(id, point ? point.uv : null, uv);
  }

  /** A point has moved in the other view: its curve moves, and with it the point, if it lies on that.
   * @param {string} id */
  follow(id) {
    const { core, leader } = this;
    const point = core.point(id);
    const before = leader?.word.points.find((one) => one.id === id)?.uv;
    const after = leader?.point(id)?.uv;
    if (point?.uv && point.snapped && before && after) point.uv = core.matching.slid(id, point.uv, before, after);
    core.canvas.invalidate("overlay");
  }

  /** Points that move no longer in the other view are where the newest message has them. */
  settle() {
    const { core, moving } = this;
    for (const id of core.state.points.keys()) if (!moving.has(id)) core.matching.rest(id);
    core.edits.merge();
  }
}
