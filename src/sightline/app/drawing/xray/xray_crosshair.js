// The cross-hair that the keyboard steers while a point is to be placed, with the magnifier at it.

/** @typedef {import("./types").Pair} Pair */

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
