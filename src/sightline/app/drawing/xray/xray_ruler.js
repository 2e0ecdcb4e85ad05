// The ruler: two clicks are a length, a third makes an angle of them. The server measures, in
// space where the other view has as many clicks.

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Shape} Shape */

const MOST = 3; // clicks

export class Ruler {
  /** @param {import("./xray.js").XrayCore} core */
  constructor(core) {
    this.core = core;
    /** @type {Pair[]} */
    this.points = [];
    this.label = "";
  }

  /** A click; after the third one the next begins anew.
   * @param {Pair} uv */
  add(uv) {
    const { core } = this;
    if (this.points.length === MOST) this.#takeAway();
    this.points = [...this.points, core.display.clamp(uv)];
    this.show("", "");
    if (this.points.length > 1) core.emit({ type: "measure", image: core.shownUrl, points: this.points });
  }

  /** What the server measured, and what that means.
   * @param {string} label
   * @param {string} note */
  show(label, note) {
    this.label = label;
    this.core.chrome.showLine(this.core.chrome.measured, note);
    if (label) this.core.chrome.say(label);
    this.core.canvas.invalidate("overlay");
  }

  end() {
    this.#takeAway();
    this.show("", "");
  }

  // The other view's ruler measures in space only while this one is shown.
  #takeAway() {
    const { core } = this;
    const told = this.points.length > 1 && core.shownUrl === core.url;
    this.points = [];
    if (told) core.emit({ type: "measure", image: core.shownUrl, points: [] });
  }

  /** @returns {Shape[]} */
  get shapes() {
    if (this.points.length === 0) return [];
    const { points, label } = this;
    return [{ shape: "line", points, style: "focus", label }, { shape: "dots", points, style: "focus" }];
  }
}
