// What a view says in words: the pixel under the pointer, how the image is shown, what lies at a place.

import { shapeDistance, STYLES } from "./xray_paint.js";

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Placed} Placed */
/** @typedef {import("./types").Shape} Shape */

const TIP_REACH = 8; // CSS pixels
const HEAD = ["head_up", "head_right", "head_down", "head_left"]; // texts, by quarter turns clockwise

/** A number with one decimal; zero without a sign.
 * @param {number} value */
const tenths = (value) => (Math.round(10 * value) / 10 + 0).toFixed(1);

export class Reading {
  /** @param {import("./xray.js").XrayCore} core */
  constructor(core) {
    this.core = core;
  }

  /** The line at the foot of the view. */
  show() {
    const { core } = this;
    const uv = core.pointer && core.display.toImage(core.pointer);
    const value = uv && this.valueAt(uv);
    if (uv === null || value === null) {
      core.chrome.showText(core.chrome.readout, core.texts.outside);
    } else {
      const [u, v] = uv.map(tenths);
      core.chrome.showText(
        core.chrome.readout,
        core.texts.readout.replace("{u}", u).replace("{v}", v).replace("{value}", String(value)),
      );
    }
    this.showState();
  }

  /** Window, zoom and orientation, and the buttons that set them. */
  showState() {
    const { chrome, display, state, texts, stream } = this.core;
    const { window: shown, inverted, tool } = state;
    const turned = [this.#orientation(), display.mirrored ? texts.mirrored : ""].filter(Boolean);
    chrome.showState(
      `C ${Math.round(shown.centre)}  W ${Math.round(shown.width)}  ×${display.zoom.toFixed(2)}`,
      turned.join(", "),
      turned.every((text) => text === texts.head_up),
    );
    for (const name of ["window", "measure"]) chrome.press(name, tool === name);
    chrome.press("invert", inverted);
    chrome.press("flip", display.mirrored);
    chrome.showPresets(stream.asked?.presets ?? {}, shown);
  }

  // Where the head is on the screen; where that is unknown, how far the image is rotated.
  #orientation() {
    const { display, texts, word } = this.core;
    const { rotation, mirrored } = display;
    const { head = null } = word;
    if (head === null) return rotation ? texts.rotated.replace("{degrees}", String(rotation)) : "";
    const at = ((mirrored ? 360 - head : head) + rotation) % 360;
    return texts[HEAD[at / 90]];
  }

  /** The nearest placed point within `reach` CSS pixels of a position in the view.
   * @param {Pair} at
   * @param {number} reach */
  pointAt(at, reach) {
    /** @type {Placed | null} */
    let best = null;
    let least = reach;
    for (const point of this.core.placed) {
      const [x, y] = this.core.display.toView(point.uv);
      const away = Math.hypot(x - at[0], y - at[1]);
      if (away <= least) [best, least] = [point, away];
    }
    return best;
  }

  /** The title of the shape at a position in the view.
   * @param {Pair} at */
  titleAt(at) {
    const { display, state, canvas, shownShapes } = this.core;
    let title = "";
    let least = TIP_REACH * canvas.unit;
    for (const shape of shownShapes) {
      if (!shape.title || (state.stale && STYLES[shape.style].plan)) continue;
      const away = shapeDistance(shape, (uv) => display.toView(uv), display.zoom, at);
      if (away < least) [title, least] = [String(shape.title), away];
    }
    return title;
  }

  /** Grey value of the pixel at (u, v); null outside the image.
   * @param {Pair} uv */
  valueAt([u, v]) {
    const { image } = this.core.state;
    const [column, row] = [Math.round(u), Math.round(v)];
    if (!image || column < 0 || row < 0 || column >= image.width || row >= image.height) return null;
    return image.pixels[row * image.width + column];
  }

  /** @param {Placed} point */
  describe(point) {
    const { texts } = this.core;
    const [u, v] = point.uv.map(tenths);
    const place = texts.point.replace("{name}", point.label).replace("{u}", u).replace("{v}", v);
    return point.snapped ? `${place}, ${texts.snapped}` : place;
  }
}

// The ruler: two clicks are a length, a third makes an angle of them. The server measures, in
// space where the other view has as many clicks.
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

// The cross-hair that the keyboard steers while a point is to be placed, with the magnifier at it.
const STEP = 10; // CSS pixels
const FINE_STEP = 1; // image pixels, with shift

export class Crosshair {
  /** @param {import("./xray.js").XrayCore} core */
  constructor(core) {
    this.core = core;
    /** @type {Pair | null} */
    this.uv = null; // where it is in the image; null: the pointer aims
  }

  /** One step in a direction on the screen, from the middle of the view at first. A point that slides stays on its curve.
   * @param {Pair} direction
   * @param {boolean} fine */
  step([right, down], fine) {
    const { core } = this;
    const point = core.point(core.state.placing);
    if (!point || !core.state.image) return;
    const size = fine ? FINE_STEP * core.display.zoom : STEP * core.canvas.unit;
    const [u, v] = this.uv ?? core.display.centre;
    const [du, dv] = this.uv ? core.display.toImageStep([right * size, down * size]) : [0, 0];
    const uv = core.display.clamp(core.edits.aimed([u + du, v + dv]));
    this.uv = uv;
    core.display.reveal(uv);
    core.lens = { uv, at: core.display.toView(uv) };
    core.chrome.say(core.reading.describe({ ...point, uv, snapped: point.slides }));
    core.settings.movedView();
  }

  /** The pointer aims again, or nothing is placed any more. */
  end() {
    if (this.uv === null) return;
    this.uv = null;
    this.core.lens = null;
    this.core.canvas.invalidate("overlay");
  }
}
