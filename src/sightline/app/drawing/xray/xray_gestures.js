// Converts mouse, pen and touch events on the view to calls of the core.
//
// One gesture at a time: pan, window, drag (of a point), place, pinch. A finger covers its target, so touch has a
// larger reach, and must move further before it counts as a drag.

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Point} Point */
/** @typedef {import("./xray.js").XrayCore} XrayCore */

/** What the person does: presses with one button, drags a point, or pinches with two fingers.
 * @typedef {{ pointer: number, type: string, from: Pair, last: Pair, moved: boolean }} Press
 * @typedef {Press & { kind: "pan" | "window" | "measure" | "place" }} Hold
 * @typedef {Press & { kind: "drag", id: string, start: Pair, grip: Pair }} Drag
 * @typedef {{ kind: "pinch", middle: Pair, span: number }} Pinch
 * @typedef {Hold | Drag | Pinch} Gesture */

/** @type {Record<string, number>} */
const REACH = { mouse: 12, pen: 16, touch: 30 }; // CSS pixels around a point
/** @type {Record<string, number>} */
const SLOP = { mouse: 0, pen: 2, touch: 6 }; // CSS pixels before a press becomes a drag
const WHEEL_ZOOM = 0.0015; // per CSS pixel of wheel: 16 % for a notch of 100
const PINCH_WHEEL_ZOOM = 0.01; // a trackpad's pinch arrives as wheel events with ctrl and small steps
const LINE_PX = 16; // for a wheel that counts lines
const WINDOW_PER_PX = 1 / 300; // [ours] a drag of 300 CSS pixels is one width of the window

const OVER_THE_PAGE = "[role=dialog], [role=listbox], [role=menu]"; // open dialogs and lists handle the Escape key themselves
/** @type {Set<Gestures>} */
const gestures = new Set(); // of all views of the page

export class Gestures {
  /** @param {import("./xray.js").XrayCore} core */
  constructor(core) {
    this.core = core;
    this.stage = core.stage;
    /** @type {Gesture | null} */
    this.now = null;
    /** @type {DOMRect | null} */
    this.box = null; // the stage's rectangle when the gesture began
    this.overPoint = false;
    /** @type {Map<number, Pair>} */
    this.pointers = new Map(); // id -> position in the view
    this.end = new AbortController();
    const { stage } = this;
    const { signal } = this.end;
    stage.addEventListener("pointerdown", (event) => this.#down(event), { signal });
    stage.addEventListener("pointermove", (event) => this.#move(event), { signal });
    stage.addEventListener("pointerrawupdate", (event) => this.#hurry(/** @type {PointerEvent} */ (event)), { signal });
    stage.addEventListener("pointerup", (event) => this.#up(event), { signal });
    stage.addEventListener("pointercancel", (event) => this.#cancel(event), { signal });
    stage.addEventListener("pointerleave", (event) => this.#leave(event), { signal });
    stage.addEventListener("wheel", (event) => this.#wheel(event), { signal, passive: false });
    stage.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
    stage.addEventListener("keydown", (event) => press(core, event), { signal });
    window.addEventListener("keydown", (event) => this.#escape(event), { signal });
    gestures.add(this);
    // Capture the event anywhere on the page, before its target gets it.
    for (const deed of ["pointerdown", "keydown", "click"]) {
      window.addEventListener(deed, (event) => this.#somethingElse(event), { signal, capture: true });
    }
  }

  destroy() {
    gestures.delete(this);
    this.end.abort();
  }

  // Whether the person is adjusting the window.
  get changesWindow() {
    return this.now !== null && this.now.kind === "window";
  }

  // The view was resized or moved: the gesture continues from its current position.
  viewChanged() {
    const { now, box: before } = this;
    if (!now || !before) return;
    const box = (this.box = this.stage.getBoundingClientRect());
    /** @type {(at: Pair) => Pair} */
    const moved = ([x, y]) => [x + before.left - box.left, y + before.top - box.top];
    for (const [id, at] of this.pointers) this.pointers.set(id, moved(at));
    if (now.kind === "pinch") now.middle = moved(now.middle);
    else Object.assign(now, { from: moved(now.from), last: moved(now.last) });
    if (now.kind === "drag") this.#grip(now, this.#place(now));
  }

  // The dragged point was removed.
  letGo() {
    this.now = null;
    this.core.state.dragging = null;
    this.core.lens = null;
    this.showCursor();
  }

  // The image has changed: end the gesture. Returns the dragged point, if any.
  leaveImage() {
    const held = this.core.state.dragging;
    if (this.now && (this.now.kind === "drag" || this.now.kind === "place")) this.letGo();
    return held;
  }

  showCursor() {
    const { state } = this.core;
    let cursor = "";
    if (state.dragging !== null) cursor = "none";
    else if (state.placing !== null || state.tool === "measure") cursor = "place";
    else if (this.now) cursor = this.now.kind;
    else if (state.tool === "window") cursor = "window";
    else if (this.overPoint) cursor = "grab";
    this.stage.dataset.cursor = cursor;
  }

  // ----------------------------------------------------------------------------------------------------------- pointers

  /** @param {MouseEvent} event
   * @returns {Pair} */
  #at(event) {
    // Once per gesture, because it may force a layout of the page.
    if (!this.now || !this.box) this.box = this.stage.getBoundingClientRect();
    return [event.clientX - this.box.left, event.clientY - this.box.top];
  }

  /** @param {PointerEvent} event */
  #down(event) {
    const at = this.#at(event);
    this.pointers.set(event.pointerId, at);
    this.stage.setPointerCapture(event.pointerId);
    this.core.chrome.showTip("", at);
    if (this.now && this.now.kind === "drag") return; // a second finger does not end a drag
    this.now = this.pointers.size >= 2 ? this.#startPinch() : this.#start(event, at);
    event.preventDefault(); // the view manages focus and selection itself
    if (this.now.kind !== "drag") this.stage.focus({ preventScroll: true });
    this.#draw(at);
  }

  /** @param {PointerEvent} event
   * @param {Pair} at
   * @returns {Hold | Drag} */
  #start(event, at) {
    const { state } = this.core;
    const base = { pointer: event.pointerId, type: event.pointerType, from: at, last: at, moved: false };
    if (event.button === 1) return { kind: "pan", ...base };
    if (event.button === 2) return { kind: "window", ...base };
    if (state.tool === "measure") return { kind: "measure", ...base };
    if (state.placing !== null) return { kind: "place", ...base };
    const point = this.core.reading.pointAt(at, this.#reach(event));
    if (point) this.core.focusPoint(point.id);
    if (point?.movable) {
      state.dragging = point.id;
      /** @type {Drag} */
      const drag = { kind: "drag", ...base, id: point.id, start: point.uv, grip: [0, 0] };
      this.#grip(drag, point.uv);
      return drag;
    }
    return { kind: state.tool === "window" ? "window" : "pan", ...base };
  }

  /** @returns {Pinch} */
  #startPinch() {
    this.core.lens = null;
    const [first, second] = [...this.pointers.values()];
    return { kind: "pinch", middle: middleOf(first, second), span: spanOf(first, second) };
  }

  /** @param {PointerEvent} event */
  #reach(event) {
    return (REACH[event.pointerType] || REACH.mouse) * this.core.canvas.unit;
  }

  /** @param {PointerEvent} event */
  #move(event) {
    const at = this.#at(event);
    if (this.pointers.has(event.pointerId)) this.pointers.set(event.pointerId, at);
    const { now } = this;
    if (!now) this.#hover(event, at);
    else if (now.kind === "pinch") this.#pinch(now);
    else if (now.pointer === event.pointerId) this.#continue(now, at);
    this.#draw(at);
  }

  /** Send a dragged point at once: the browser delays "pointermove" until its next frame.
   * @param {PointerEvent} event */
  #hurry(event) {
    const { now } = this;
    if (now && now.kind === "drag" && now.pointer === event.pointerId) this.#continue(now, this.#at(event));
  }

  /** @param {PointerEvent} event
   * @param {Pair} at */
  #hover(event, at) {
    const { core } = this;
    const point = core.reading.pointAt(at, this.#reach(event));
    this.overPoint = Boolean(point?.movable);
    core.hover(point ? point.id : null);
    core.chrome.showTip(core.state.placing === null && !point ? core.reading.titleAt(at) : "", at);
  }

  /** @type {(gesture: Hold | Drag, at: Pair) => void} */
  #continue(gesture, at) {
    if (gesture.moved && at[0] === gesture.last[0] && at[1] === gesture.last[1]) return;
    if (!gesture.moved) {
      const slop = SLOP[gesture.type] || 0;
      if (Math.hypot(at[0] - gesture.from[0], at[1] - gesture.from[1]) < slop) return;
      gesture.moved = true;
      if (slop > 0) gesture.last = at; // so that the point does not jump by the slop
      if (slop > 0 && gesture.kind === "drag") this.#grip(gesture, gesture.start);
    }
    const [dx, dy] = [at[0] - gesture.last[0], at[1] - gesture.last[1]];
    gesture.last = at;
    if (gesture.kind === "window") this.#window(dx, dy);
    if (gesture.kind === "drag") this.core.edits.move("drag", gesture.id, this.#held(gesture, at));
    if (gesture.kind === "pan") {
      this.core.display.panBy(dx, dy);
      this.core.settings.movedView();
    }
  }

  /** @type {(drag: Drag, uv: Pair) => void} */
  #grip(drag, uv) {
    const [x, y] = this.core.display.toView(uv);
    drag.grip = [x - drag.last[0], y - drag.last[1]];
  }

  /** Where the dragged point is now.
   * @param {Drag} drag */
  #place(drag) {
    return this.core.point(drag.id)?.uv ?? drag.start;
  }

  /** @type {(drag: Drag, at: Pair) => Pair} */
  #held(drag, at) {
    return this.core.display.toImage([at[0] + drag.grip[0], at[1] + drag.grip[1]]);
  }

  /** Right: wider window; up: brighter.
   * @param {number} dx
   * @param {number} dy */
  #window(dx, dy) {
    const { window: shown, inverted } = this.core.state;
    const width = shown.width * Math.exp(dx * WINDOW_PER_PX);
    this.core.settings.setWindow({ width, centre: shown.centre + (inverted ? -dy : dy) * shown.width * WINDOW_PER_PX });
  }

  /** @param {Pinch} gesture */
  #pinch(gesture) {
    if (this.pointers.size < 2) return;
    const [first, second] = [...this.pointers.values()];
    const [middle, span] = [middleOf(first, second), spanOf(first, second)];
    this.core.display.panBy(middle[0] - gesture.middle[0], middle[1] - gesture.middle[1]);
    this.core.display.zoomAt(span / gesture.span, middle);
    Object.assign(gesture, { middle, span });
    this.core.settings.movedView();
  }

  /** @param {PointerEvent} event */
  #up(event) {
    const at = this.#at(event);
    this.pointers.delete(event.pointerId);
    const gesture = this.now;
    if (!gesture) return;
    if (gesture.kind === "pinch") {
      if (this.pointers.size === 0) this.now = null; // a remaining finger has no effect
    } else if (gesture.pointer === event.pointerId) {
      this.now = null;
      this.#finish(gesture, at);
    }
    this.#draw(at);
  }

  /** @type {(gesture: Hold | Drag, at: Pair) => void} */
  #finish(gesture, at) {
    const { core } = this;
    if (gesture.kind === "measure") core.ruler.add(core.display.toImage(at));
    if (gesture.kind === "place") core.edits.placeAt(core.display.toImage(at));
    if (gesture.kind === "window" && gesture.moved) core.settings.send();
    if (gesture.kind === "drag") this.#drop(gesture.moved ? "drop" : null, gesture);
    if (gesture.kind === "pan" && !gesture.moved) {
      if (!core.reading.pointAt(at, REACH.mouse * core.canvas.unit)) core.select(null);
      core.chrome.showTip(core.reading.titleAt(at), at);
    }
  }

  /** @type {(type: string | null, drag: Drag) => void} */
  #drop(type, drag) {
    this.core.state.dragging = null;
    if (type) this.core.edits.move(type, drag.id, this.#place(drag));
    else this.core.release();
    this.core.canvas.invalidate("overlay");
  }

  /** @param {PointerEvent} event */
  #cancel(event) {
    this.pointers.delete(event.pointerId);
    if (this.now && this.now.kind === "drag" && this.now.pointer === event.pointerId) this.#takeBack(this.now);
    this.now = null;
    this.core.lens = null;
    this.core.release();
    this.#draw(null);
  }

  /** Cancel the drag: the point returns to its start.
   * @param {Drag} drag */
  #takeBack(drag) {
    this.now = null;
    const point = this.core.point(drag.id);
    if (point) point.uv = drag.start;
    this.core.edits.clamped = null;
    this.#drop(drag.moved ? "drop" : null, drag);
  }

  /** @param {PointerEvent} event */
  #leave(event) {
    if (this.pointers.has(event.pointerId)) return;
    this.overPoint = false;
    this.core.hover(null);
    this.core.chrome.showTip("", [0, 0]);
    this.#draw(null);
  }

  /** Update the magnifier, the readout and the cursor.
   * @param {Pair | null} at */
  #draw(at) {
    const { core } = this;
    const { dragging, placing, points } = core.state;
    const had = core.lens !== null;
    core.pointer = at;
    if (at === null && core.crosshair.uv) return;
    core.crosshair.end();
    core.lens = null;
    const uv = points.get(dragging ?? "")?.uv;
    if (at && uv && this.now?.kind === "drag" && this.now.moved) {
      core.lens = { uv, at: core.display.toView(uv) };
    } else if (at && core.state.tool === "measure" && core.state.image) {
      core.lens = { uv: core.display.clamp(core.display.toImage(at)), at }; // where a click is taken
    } else if (at && placing !== null && core.state.image && (!this.now || this.now.kind === "place")) {
      const aimed = core.edits.aimed(core.display.toImage(at));
      if (core.display.contains(aimed)) core.lens = { uv: aimed, at }; // elsewhere a click places nothing
    }
    if (had || core.lens) core.canvas.invalidate("overlay");
    core.canvas.invalidate("readout");
    this.showCursor();
  }

  /** @param {WheelEvent} event */
  #wheel(event) {
    event.preventDefault();
    const at = this.#at(event);
    const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? LINE_PX : 1);
    this.core.display.zoomAt(Math.exp(-pixels * (event.ctrlKey ? PINCH_WHEEL_ZOOM : WHEEL_ZOOM)), at);
    this.core.settings.movedView();
    this.#draw(at);
  }

  // --------------------------------------------------------------------------------------------------------------- keys

  /** Held arrow keys repeat faster than the server answers.
   * @param {Event & { key?: string }} event */
  #somethingElse(event) {
    if (ARROWS[event.key ?? ""] && this.stage.contains(/** @type {Node} */ (event.target))) return;
    this.core.edits.moves.flush();
  }

  /** Escape works anywhere on the page, because the button that began the placing may still have the focus. One press
   * ends one thing in any view, a current gesture first.
   * @param {KeyboardEvent} event */
  #escape(event) {
    if (event.key !== "Escape" || event.defaultPrevented) return;
    if ([...document.querySelectorAll(OVER_THE_PAGE)].some((element) => element.checkVisibility())) return;
    /** @param {"endDrag" | "endMeasuring" | "endPlacing" | "endEnlarged"} what */
    const ends = (what) => [...gestures].some((each) => each[what]());
    if (ends("endDrag") || ends("endMeasuring") || ends("endPlacing") || ends("endEnlarged")) event.preventDefault();
  }

  // Returns true if there was something to end.
  endDrag() {
    if (!this.now || this.now.kind !== "drag") return false;
    this.#takeBack(this.now);
    this.#draw(this.core.pointer);
    return true;
  }

  endMeasuring() {
    const measures = this.core.state.tool === "measure";
    if (measures) this.core.settings.setTool("pan");
    return measures;
  }

  endPlacing() {
    if (this.core.state.placing === null) return false;
    this.now = null;
    this.core.edits.cancelPlacing();
    return true;
  }

  endEnlarged() {
    const { maximised } = this.core.state;
    this.core.settings.maximise(false);
    return maximised;
  }
}

/** @type {(first: Pair, second: Pair) => Pair} */
const middleOf = (first, second) => [(first[0] + second[0]) / 2, (first[1] + second[1]) / 2];
/** @type {(first: Pair, second: Pair) => number} */
const spanOf = (first, second) => Math.max(Math.hypot(first[0] - second[0], first[1] - second[1]), 1);

// Converts key events on the view to calls of the core. Escape, which ends a gesture, is with the gestures.
const PAN_KEY = 40; // CSS pixels
const STEP = 1; // image pixels an arrow key moves a point
const FINE_STEP = 0.1; // with shift

/** Directions on the screen by the names of their keys.
 * @type {Record<string, Pair | undefined>} */
export const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** Does what the key stands for at the element that has the focus.
 * @type {(core: XrayCore, event: KeyboardEvent) => void} */
export function press(core, event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return; // shortcuts of the browser
  const { id } = /** @type {HTMLElement} */ (event.target).dataset;
  const point = core.point(id ?? null);
  const direction = ARROWS[event.key];
  if (direction) arrow(core, direction, event.shiftKey, point);
  else if (!otherKey(core, event.key, point)) return;
  event.preventDefault();
}

/** @type {(core: XrayCore, direction: Pair, fine: boolean, point: Point | null) => void} */
function arrow(core, direction, fine, point) {
  if (!point && core.state.placing !== null) {
    core.crosshair.step(direction, fine);
  } else if (!point) {
    core.display.panBy(-direction[0] * PAN_KEY, -direction[1] * PAN_KEY);
    core.settings.movedView();
  } else if (point.movable && point.uv) {
    const size = (fine ? FINE_STEP : STEP) * core.display.zoom; // one image pixel in the direction on screen
    const [du, dv] = core.display.toImageStep([direction[0] * size, direction[1] * size]);
    core.edits.move("nudge", point.id, [point.uv[0] + du, point.uv[1] + dv]);
  }
}

/** Returns whether the key stands for anything.
 * @type {(core: XrayCore, key: string, point: Point | null) => boolean} */
function otherKey(core, key, point) {
  if (key === "+" || key === "=") core.settings.zoom(true);
  else if (key === "-" || key === "_") core.settings.zoom(false);
  else if (key === "Delete" && point) core.edits.remove(point.id);
  else if (key === "Enter" && core.state.placing !== null) core.edits.placeAt(core.crosshair.uv ?? core.display.centre);
  else return false;
  return true;
}
