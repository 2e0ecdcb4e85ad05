// Points of one view that move with those of another: on their image-matching curves.

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./xray.js").XrayCore} XrayCore */

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
