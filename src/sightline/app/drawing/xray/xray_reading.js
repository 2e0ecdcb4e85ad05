// What a view says in words: the pixel under the pointer, how the image is shown, what lies at a place.

import { shapeDistance, STYLES } from "./xray_paint.js";

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Placed} Placed */

const TIP_REACH = 8; // CSS pixels
const HEAD = ["head_up", "head_right", "head_down", "head_left"]; // texts, by quarter turns clockwise

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
      const [u, v] = uv.map((number) => number.toFixed(1));
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
    const [u, v] = point.uv.map((value) => value.toFixed(1));
    const place = texts.point.replace("{name}", point.label).replace("{u}", u).replace("{v}", v);
    return point.snapped ? `${place}, ${texts.snapped}` : place;
  }
}
