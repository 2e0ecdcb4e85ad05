// How the person has the image drawn: grey-level window, zoom, orientation, size of the view, and the tool in use.

import { heldWindow } from "./xray_stream.js";

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Window} Window_ */
/** @typedef {import("./xray_display.js").Display} Display */
/** @typedef {"pan" | "window" | "measure"} Tool what a drag or click with the left button does */

const ZOOM_STEP = 1.25; // per key press

export class Settings {
  /** @param {import("./xray.js").XrayCore} core */
  constructor(core) {
    this.core = core;
    /** @type {number | null} */
    this.undone = null; // number of the change that is not acknowledged
    this.place = document.createComment("enlarged"); // marks the view's place in the page
  }

  /** What each button of the view does. */
  get actions() {
    const { display, state } = this.core;
    return {
      fit: () => {
        display.fit();
        this.movedView();
      },
      link: () => this.#link(!state.linked),
      measure: () => this.setTool(state.tool === "measure" ? "pan" : "measure"),
      window: () => this.setTool(state.tool === "window" ? "pan" : "window"),
      invert: () => this.#change(() => this.#setInverted(!state.inverted)),
      flip: () => this.#change(() => display.flip()),
      rotate: () => this.#change(() => display.turnClockwise()),
      /** @param {Window_} shown */
      preset: (shown) => this.#change(() => this.setWindow(shown)),
      reset: () => this.#change(() => this.#reset()),
      maximise: () => this.maximise(!state.maximised),
    };
  }

  /** Shows the message's settings, unless the person's own are not acknowledged; the window waits for its pixels. */
  show() {
    const { core } = this;
    const { display } = core.word;
    if (display === null || this.undone !== null || core.gestures.changesWindow) return;
    const { rotation, mirrored, inverted, window: shown } = display;
    if (rotation !== core.display.rotation || mirrored !== core.display.mirrored) {
      core.display.orient(rotation, mirrored);
      this.#turned();
    }
    if (core.stream.loading) return;
    const [held, now] = [heldWindow(shown), core.state.window];
    if (held.centre !== now.centre || held.width !== now.width) this.setWindow(held);
    if (inverted !== core.state.inverted) this.#setInverted(inverted);
  }

  /** Tells the server how the image is drawn now. */
  send() {
    const { core } = this;
    const { rotation, mirrored } = core.display;
    const { inverted, window: shown } = core.state;
    const seq = (this.undone = core.edits.moves.number());
    core.emit({ type: "display", image: core.shownUrl, seq, rotation, mirrored, inverted, window: { ...shown } });
  }

  /** The action of this number is acknowledged.
   * @param {number} seq */
  acknowledge(seq) {
    if (this.undone === seq) this.undone = null;
  }

  giveUp() {
    this.undone = null;
  }

  /** @param {Window_} shown */
  setWindow(shown) {
    this.core.state.window = heldWindow(shown);
    this.core.canvas.invalidate("table");
  }

  /** The image has another place or size in the view; linked views follow. */
  movedView() {
    const { canvas, state, display } = this.core;
    canvas.invalidate("image", "overlay", "readout");
    if (state.linked) for (const view of this.#others()) view.settings.zoomAlong(display);
  }

  /** Another view has this zoom: the selected point stays in its place, or else the middle.
   * @param {Display} display */
  zoomAlong(display) {
    if (!this.core.display.follow(display, this.#selectedPlace())) return;
    this.core.canvas.invalidate("image", "overlay", "readout");
  }

  /** @param {boolean} inwards */
  zoom(inwards) {
    const { display, stage } = this.core;
    const at = document.activeElement === stage ? display.middle : this.#selectedPlace();
    display.zoomAt(inwards ? ZOOM_STEP : 1 / ZOOM_STEP, at);
    this.movedView();
  }

  /** @param {Tool} tool */
  setTool(tool) {
    const { core } = this;
    core.state.tool = tool;
    core.ruler.end();
    core.lens = null;
    core.reading.showState();
    core.gestures.showCursor();
  }

  /** Moved to the top level of the page: within its own box, later elements would cover it.
   * @param {boolean} on */
  maximise(on) {
    const { root, state, chrome } = this.core;
    if (on === state.maximised) return;
    const focused = /** @type {HTMLElement} */ (document.activeElement);
    if (on) {
      root.replaceWith(this.place);
      document.body.append(root);
    } else {
      this.place.replaceWith(root);
    }
    if (root.contains(focused)) focused.focus({ preventScroll: true }); // a moved element loses the focus
    state.maximised = on;
    root.classList.toggle("xray-maximised", on);
    chrome.relabel("maximise", on ? "restore" : "maximise");
    chrome.press("maximise", on);
  }

  #selectedPlace() {
    const { core } = this;
    const point = core.point(core.state.selected);
    return point?.uv ? core.display.toView(point.uv) : core.display.middle;
  }

  #others() {
    return Object.values(window.sightlineXray).filter((view) => view !== this.core);
  }

  /** @param {boolean} on */
  #link(on) {
    for (const view of Object.values(window.sightlineXray)) {
      view.state.linked = on;
      view.chrome.press("link", on);
    }
    this.movedView();
  }

  /** @param {() => void} change */
  #change(change) {
    change();
    this.#turned();
    this.send();
  }

  #turned() {
    this.core.reading.showState();
    this.movedView();
  }

  #reset() {
    const { core } = this;
    core.display.orient((360 - (core.word.head ?? 0)) % 360, false);
    core.display.fit();
    const { asked } = core.stream;
    if (asked) this.setWindow(asked.window);
    this.#setInverted(false);
  }

  /** @param {boolean} on */
  #setInverted(on) {
    this.core.state.inverted = on;
    this.core.canvas.invalidate("table");
    this.core.reading.showState();
  }
}
