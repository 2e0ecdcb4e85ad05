// Converts mouse, pen and touch events on the view to calls of the core.
//
// One gesture at a time: pan, window, drag (of a point), place, pinch. A finger covers its target, so touch has a
// larger reach, and must move further before it counts as a drag.

import { ARROWS, press } from "./xray_keys.js";

const REACH = { mouse: 12, pen: 16, touch: 30 }; // CSS pixels around a point
const SLOP = { mouse: 0, pen: 2, touch: 6 }; // CSS pixels before a press becomes a drag
const WHEEL_ZOOM = 0.0015; // per CSS pixel of wheel: 16 % for a notch of 100
const PINCH_WHEEL_ZOOM = 0.01; // a trackpad's pinch arrives as wheel events with ctrl and small steps
const LINE_PX = 16; // for a wheel that counts lines
const WINDOW_PER_PX = 1 / 300; // [ours] a drag of 300 CSS pixels is one width of the window

const OVER_THE_PAGE = "[role=dialog], [role=listbox], [role=menu]"; // open dialogs and lists handle the Escape key themselves
const gestures = new Set(); // of all views of the page

export class Gestures {
  constructor(core) {
    this.core = core;
    this.stage = core.stage;
    /** @type {any} */
    this.now = null; // {kind, ...}
    this.box = null; // the stage's rectangle when the gesture began
    this.pointers = new Map(); // id -> position in the view
    this.end = new AbortController();
    const listen = (target, type, handler, options = {}) =>
      target.addEventListener(type, handler, { signal: this.end.signal, ...options });
    listen(this.stage, "pointerdown", (event) => this.#down(event));
    listen(this.stage, "pointermove", (event) => this.#move(event));
    listen(this.stage, "pointerrawupdate", (event) => this.#hurry(event));
    listen(this.stage, "pointerup", (event) => this.#up(event));
    listen(this.stage, "pointercancel", (event) => this.#cancel(event));
    listen(this.stage, "pointerleave", (event) => this.#leave(event));
    listen(this.stage, "wheel", (event) => this.#wheel(event), { passive: false });
    listen(this.stage, "contextmenu", (event) => event.preventDefault());
    listen(this.stage, "keydown", (event) => press(core, event));
    listen(window, "keydown", (event) => this.#escape(event));
    gestures.add(this);
    // Capture the event anywhere on the page, before its target gets it.
    for (const deed of ["pointerdown", "keydown", "click"]) {
      listen(window, deed, (event) => this.#somethingElse(event), { capture: true });
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
    if (!this.now || !this.box) return;
    const { left, top } = this.box;
    this.box = this.stage.getBoundingClientRect();
    const moved = ([x, y]) => [x + left - this.box.left, y + top - this.box.top];
    for (const [id, at] of this.pointers) this.pointers.set(id, moved(at));
    for (const what of ["from", "last", "middle"]) if (this.now[what]) this.now[what] = moved(this.now[what]);
    if (this.now.kind === "drag") this.#grip(this.now, this.core.state.points.get(this.now.id).uv);
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

  #at(event) {
    // Once per gesture, because it may force a layout of the page.
    if (!this.now || !this.box) this.box = this.stage.getBoundingClientRect();
    return [event.clientX - this.box.left, event.clientY - this.box.top];
  }

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
      const drag = { kind: "drag", ...base, id: point.id, start: point.uv };
      this.#startFrom(drag, at);
      return drag;
    }
    return { kind: state.tool === "window" ? "window" : "pan", ...base };
  }

  #startPinch() {
    this.core.lens = null;
    const [first, second] = [...this.pointers.values()];
    return { kind: "pinch", middle: middleOf(first, second), span: spanOf(first, second) };
  }

  #reach(event) {
    return (REACH[event.pointerType] || REACH.mouse) * this.core.canvas.unit;
  }

  #move(event) {
    const at = this.#at(event);
    if (this.pointers.has(event.pointerId)) this.pointers.set(event.pointerId, at);
    if (!this.now) this.#hover(event, at);
    else if (this.now.kind === "pinch") this.#pinch();
    else if (this.now.pointer === event.pointerId) this.#continue(at);
    this.#draw(at);
  }

  // Send a dragged point at once: the browser delays "pointermove" until its next frame.
  #hurry(event) {
    const { now } = this;
    if (now && now.kind === "drag" && now.pointer === event.pointerId) this.#continue(this.#at(event));
  }

  #hover(event, at) {
    const { core } = this;
    const point = core.reading.pointAt(at, this.#reach(event));
    this.overPoint = Boolean(point?.movable);
    core.hover(point ? point.id : null);
    core.chrome.showTip(core.state.placing === null && !point ? core.reading.titleAt(at) : "", at);
  }

  #continue(at) {
    const gesture = this.now;
    if (gesture.moved && at[0] === gesture.last[0] && at[1] === gesture.last[1]) return;
    if (!gesture.moved) {
      const slop = SLOP[gesture.type] || 0;
      if (Math.hypot(at[0] - gesture.from[0], at[1] - gesture.from[1]) < slop) return;
      gesture.moved = true;
      if (slop > 0) this.#startFrom(gesture, at); // so that the point does not jump by the slop
    }
    const [dx, dy] = [at[0] - gesture.last[0], at[1] - gesture.last[1]];
    gesture.last = at;
    if (gesture.kind === "window") this.#window(dx, dy);
    if (gesture.kind === "drag") this.core.edits.move("drag", gesture.id, this.#held(at));
    if (gesture.kind === "pan") {
      this.core.display.panBy(dx, dy);
      this.core.settings.movedView();
    }
  }

  #startFrom(gesture, at) {
    gesture.last = at;
    if (gesture.kind !== "drag") return;
    this.#grip(gesture, gesture.start);
  }

  #grip(gesture, uv) {
    const [x, y] = this.core.display.toView(uv);
    gesture.grip = [x - gesture.last[0], y - gesture.last[1]];
  }

  #held(at) {
    return this.core.display.toImage([at[0] + this.now.grip[0], at[1] + this.now.grip[1]]);
  }

  // Right: wider window; up: brighter.
  #window(dx, dy) {
    const { window: shown, inverted } = this.core.state;
    const width = shown.width * Math.exp(dx * WINDOW_PER_PX);
    this.core.settings.setWindow({ width, centre: shown.centre + (inverted ? -dy : dy) * shown.width * WINDOW_PER_PX });
  }

  #pinch() {
    if (this.pointers.size < 2) return;
    const [first, second] = [...this.pointers.values()];
    const [middle, span] = [middleOf(first, second), spanOf(first, second)];
    this.core.display.panBy(middle[0] - this.now.middle[0], middle[1] - this.now.middle[1]);
    this.core.display.zoomAt(span / this.now.span, middle);
    Object.assign(this.now, { middle, span });
    this.core.settings.movedView();
  }

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

  #drop(type, { id }) {
    this.core.state.dragging = null;
    if (type) this.core.edits.move(type, id, this.core.state.points.get(id).uv);
    else this.core.release();
    this.core.canvas.invalidate("overlay");
  }

  #cancel(event) {
    this.pointers.delete(event.pointerId);
    if (this.now && this.now.kind === "drag" && this.now.pointer === event.pointerId) this.#takeBack();
    this.now = null;
    this.core.lens = null;
    this.core.release();
    this.#draw(null);
  }

  // Cancel the drag: the point returns to its start.
  #takeBack() {
    const gesture = this.now;
    this.now = null;
    this.core.state.points.get(gesture.id).uv = gesture.start;
    this.#drop(gesture.moved ? "drop" : null, gesture);
  }

  #leave(event) {
    if (this.pointers.has(event.pointerId)) return;
    this.overPoint = false;
    this.core.hover(null);
    this.core.chrome.showTip("", [0, 0]);
    this.#draw(null);
  }

  // Update the magnifier, the readout and the cursor.
  #draw(at) {
    const { core } = this;
    const { dragging, placing, points } = core.state;
    const had = core.lens !== null;
    core.pointer = at;
    if (at === null && core.crosshair.uv) return;
    core.crosshair.end();
    core.lens = null;
    if (at && dragging !== null && this.now && this.now.moved) {
      const { uv } = points.get(dragging);
      core.lens = { uv, at: core.display.toView(uv) };
    } else if (at && core.state.tool === "measure" && core.state.image) {
      core.lens = { uv: core.display.toImage(at), at };
    } else if (at && placing !== null && core.state.image && (!this.now || this.now.kind === "place")) {
      core.lens = { uv: core.edits.aimed(core.display.toImage(at)), at };
    }
    if (had || core.lens) core.canvas.invalidate("overlay");
    core.canvas.invalidate("readout");
    this.showCursor();
  }

  #wheel(event) {
    event.preventDefault();
    const at = this.#at(event);
    const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? LINE_PX : 1);
    this.core.display.zoomAt(Math.exp(-pixels * (event.ctrlKey ? PINCH_WHEEL_ZOOM : WHEEL_ZOOM)), at);
    this.core.settings.movedView();
    this.#draw(at);
  }

  // --------------------------------------------------------------------------------------------------------------- keys

  // Held arrow keys repeat faster than the server answers.
  #somethingElse(event) {
    if (ARROWS[event.key] && this.stage.contains(event.target)) return;
    this.core.edits.moves.flush();
  }

  // Escape works anywhere on the page, because the button that began the placing may still have the focus. One press
  // ends one thing in any view, a current gesture first.
  #escape(event) {
    if (event.key !== "Escape" || event.defaultPrevented) return;
    if ([...document.querySelectorAll(OVER_THE_PAGE)].some((element) => element.checkVisibility())) return;
    const ends = (what) => [...gestures].some((each) => each[what]());
    if (ends("endDrag") || ends("endMeasuring") || ends("endPlacing") || ends("endEnlarged")) event.preventDefault();
  }

  // Returns true if there was something to end.
  endDrag() {
    if (!this.now || this.now.kind !== "drag") return false;
    this.#takeBack();
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

const middleOf = (first, second) => [(first[0] + second[0]) / 2, (first[1] + second[1]) / 2];
const spanOf = (first, second) => Math.max(Math.hypot(first[0] - second[0], first[1] - second[1]), 1);
