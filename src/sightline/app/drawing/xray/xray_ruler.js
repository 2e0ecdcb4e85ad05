// The ruler: two clicks are a length, a third makes an angle of them. The server measures; nothing is kept.

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
    this.points = [...(this.points.length < MOST ? this.points : []), core.display.clamp(uv)];
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
    this.points = [];
    this.show("", "");
  }

  /** @returns {Shape[]} */
  get shapes() {
    if (this.points.length === 0) return [];
    const { points, label } = this;
    return [{ shape: "line", points, style: "focus", label }, { shape: "dots", points, style: "focus" }];
  }
}
