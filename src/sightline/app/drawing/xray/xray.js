// The X-ray view: an image with layers of shapes, and points that a person places and moves. Uses no framework.
//
// The core holds the state and takes messages and actions; others draw (xray_canvas.js), listen (xray_gestures.js), load
// images (xray_stream.js), say what is seen (xray_reading.js) and follow the other view (xray_following.js).
// Coordinates are image pixels (see xray_display.js); the person's actions go out through `emit`.
//
// `word` is the server's newest message, the complete content of the view. A person's action is drawn over it at once;
// when the server acknowledges it, `word` replaces it.

import { Age } from "./xray_age.js";
import { Canvas } from "./xray_canvas.js";
import { Chrome } from "./xray_chrome.js";
import { Crosshair } from "./xray_crosshair.js";
import { Display } from "./xray_display.js";
import { Following } from "./xray_following.js";
import { Gestures } from "./xray_gestures.js";
import { Matching } from "./xray_matching.js";
import { Moves } from "./xray_moves.js";
import { shapeFault, STYLES } from "./xray_paint.js";
import { heldWindow } from "./xray_picture.js";
import { PointButtons } from "./xray_points.js";
import { Reading } from "./xray_reading.js";
import { Ruler } from "./xray_ruler.js";
import { Stream } from "./xray_stream.js";

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Point} Point */
/** @typedef {import("./types").PointSent} PointSent */
/** @typedef {import("./types").Placed} Placed */
/** @typedef {import("./types").Shape} Shape */
/** @typedef {import("./types").Picture} Picture */
/** @typedef {import("./types").Image} Image */
/** @typedef {import("./types").Window} Window_ */
/** @typedef {import("./types").Word} Word */
/** @typedef {import("./types").Move} Move */
/** @typedef {"pan" | "window" | "measure"} Tool what a drag or click with the left button does */
/**
 * @typedef {{ image: Image | null, window: Window_, inverted: boolean, linked: boolean, stale: boolean,
 *   maximised: boolean, tool: Tool, placing: string | null, selected: string | null, hovered: string | null,
 *   dragging: string | null, points: Map<string, Point>, layers: Map<string, { shapes: Shape[] }> }} State
 */

const ZOOM_STEP = 1.25; // per key press
/** @type {Word} */
const NOTHING = {
  version: 0,
  label: "",
  picture: null,
  display: null,
  layers: {},
  points: [],
  placing: null,
  notice: null,
  revision: "",
  matching: null,
  head: null,
};

export class XrayCore {
  /** `emit(event)` gets every event, `keep(move | null)` the newest edit that the server has not acknowledged.
   * @param {HTMLElement} root
   * @param {{ name: string, label: string, texts: import("./types").Texts, emit: (event: object) => void,
   *   keep: (move: Move | null) => void }} options */
  constructor(root, { name, label, texts, emit, keep }) {
    this.root = root;
    this.name = name;
    this.texts = texts;
    this.emit = emit;
    this.display = new Display();
    this.moves = new Moves(emit, keep);
    /** @type {State} */
    this.state = {
      image: null,
      window: { centre: 0, width: 1 },
      inverted: false,
      linked: false, // all views of the page zoom together
      stale: false,
      maximised: false,
      tool: "pan",
      placing: null,
      selected: null,
      hovered: null,
      dragging: null,
      points: new Map(),
      layers: new Map(),
    };
    this.word = NOTHING;
    this.undone = nothingUndone();
    this.place = document.createComment("enlarged"); // marks the view's place in the page
    this.chrome = new Chrome(root, label, texts, this.#actions());
    this.stage = this.chrome.stage;
    this.canvas = new Canvas(this);
    this.reading = new Reading(this);
    this.matching = new Matching();
    this.following = new Following(this);
    this.crosshair = new Crosshair(this);
    this.ruler = new Ruler(this);
    /** @type {{ uv: Pair, at: Pair } | null} */
    this.lens = null; // the pixel in the magnifier, and its position in the view
    /** @type {Pair | null} */
    this.pointer = null; // position of the pointer in the view; null outside
    this.stream = new Stream((image) => this.#takeImage(image), (message) => this.#loadFailed(message));
    this.age = new Age((stale) => this.#showStale(stale));
    this.buttons = new PointButtons(this.chrome.points, (id) => this.select(id));
    this.gestures = new Gestures(this);
    this.observer = new ResizeObserver(() => this.#resize());
    this.observer.observe(this.stage);
    this.resized = () => this.#resize(); // on another screen the size in CSS pixels may stay the same
    window.addEventListener("resize", this.resized);
    window.sightlineXray = window.sightlineXray || {};
    window.sightlineXray[name] = this;
    this.#resize();
    this.reading.showState();
    emit({ type: "ready" });
  }

  destroy() {
    if (this.state.maximised) this.root.remove();
    this.observer.disconnect();
    window.removeEventListener("resize", this.resized);
    this.gestures.destroy();
    this.stream.end();
    this.age.end();
    this.canvas.end();
    if (window.sightlineXray[this.name] === this) delete window.sightlineXray[this.name];
  }

  // ------------------------------------------------------------------------------------------------ server messages

  /** Show this content; returns false if a newer message is known. `freshMs`: see `setFresh`.
   * @param {Word & { freshMs: number | null }} message */
  show({ freshMs, ...word }) {
    if (word.version <= this.word.version) return false;
    this.word = word;
    this.chrome.setLabel(word.label);
    this.chrome.showLine(this.chrome.notice, word.notice);
    this.#showPicture(word.picture, freshMs);
    this.#showLayers(word.layers);
    this.matching.show(word.matching, this.#layerShapes, (message) => this.#report(message));
    this.#showDisplay();
    this.mergePoints();
    this.#showPlacing();
    this.reading.showState();
    return true;
  }

  /** The action of this number is acknowledged: `word` replaces it.
   * @param {number} seq */
  acknowledge(seq) {
    const { undone } = this;
    for (const [id, number] of [...undone.points]) if (number === seq) undone.points.delete(id);
    if (undone.placing === seq) undone.placing = null;
    if (undone.display === seq) undone.display = null;
    this.moves.acknowledge(seq);
    this.release();
    this.#showPlacing();
  }

  // Discard unacknowledged actions.
  giveUp() {
    this.undone = nothingUndone();
    this.release();
    this.#showPlacing();
  }

  /** @type {(picture: Picture | null, freshMs: number | null) => void} */
  #showPicture(picture, freshMs) {
    const url = picture?.url ?? null;
    this.setFresh(url, freshMs);
    if (!this.stream.isNew(picture)) return;
    if (url !== this.url) this.#letGo();
    this.stream.load(picture);
  }

  /** Layers by name, drawn in this order; null: as in the message before.
   * @param {Record<string, Shape[] | null>} layers */
  #showLayers(layers) {
    const before = new Map(this.state.layers);
    this.state.layers.clear();
    for (const [name, sent] of Object.entries(layers)) {
      const shapes = sent ?? before.get(name)?.shapes ?? [];
      const faults = shapes.map(shapeFault).filter(Boolean);
      if (faults.length) this.#report(`layer ${name}: ${faults[0]}`);
      this.state.layers.set(name, { shapes: faults.length ? shapes.filter((shape) => !shapeFault(shape)) : shapes });
    }
    const ticks = this.#layerShapes.some(({ shape }) => shape === "ticks");
    this.chrome.showLine(this.chrome.legend, ticks ? this.texts.ticks : "");
    this.canvas.invalidate("overlay");
  }

  // The points of `word`; a point being dragged, or moved and not acknowledged, keeps its position.
  mergePoints() {
    const before = this.state.points;
    this.state.points = new Map(this.word.points.map((point) => [point.id, this.#point(point, before.get(point.id))]));
    for (const id of before.keys()) if (!this.state.points.has(id)) this.#dropPoint(id);
    this.#showPoints();
    this.canvas.invalidate("overlay");
  }

  // The next click places this point; null: none.
  #showPlacing() {
    const id = this.undone.placing === null ? this.word.placing : null;
    if (id === this.state.placing) return;
    this.state.placing = id;
    this.crosshair.end();
    if (id === null) this.lens = null;
    this.chrome.showLine(this.chrome.hint, id === null ? "" : this.texts.placing.replace("{name}", this.#nameOf(id)));
    this.gestures.showCursor();
    this.canvas.invalidate("overlay");
  }

  // How the image is drawn; the window waits for the pixels it belongs to.
  #showDisplay() {
    const { display } = this.word;
    if (display === null || this.undone.display !== null || this.gestures.changesWindow) return;
    const { rotation, mirrored, inverted, window: shown } = display;
    if (rotation !== this.display.rotation || mirrored !== this.display.mirrored) {
      this.display.orient(rotation, mirrored);
      this.#turned();
    }
    if (this.stream.loading) return;
    const [held, now] = [heldWindow(shown), this.state.window];
    if (held.centre !== now.centre || held.width !== now.width) this.setWindow(held);
    if (inverted !== this.state.inverted) this.#setInverted(inverted);
  }

  /** The image at `url` is current for `ms`, unless extended; null: it does not expire.
   * @param {string | null} url
   * @param {number | null} ms */
  setFresh(url, ms) {
    this.age.extend(url, ms, this.shownUrl);
  }

  // Freshness is no longer reported.
  loseTouch() {
    this.age.loseTouch();
  }

  // ------------------------------------------------------------------------------------------------ person's actions

  /** @param {Window_} shown */
  setWindow(shown) {
    this.state.window = heldWindow(shown);
    this.canvas.invalidate("table");
  }

  movedView() {
    this.canvas.invalidate("image", "overlay", "readout");
    if (this.state.linked) for (const view of this.#others()) view.zoomAlong(this.display);
  }

  /** Another view has this zoom: the selected point stays in its place, or else the middle.
   * @param {Display} display */
  zoomAlong(display) {
    if (this.display.follow(display, this.#selectedPlace())) this.canvas.invalidate("image", "overlay", "readout");
  }

  /** @param {boolean} inwards */
  zoom(inwards) {
    const at = document.activeElement === this.stage ? this.display.middle : this.#selectedPlace();
    this.display.zoomAt(inwards ? ZOOM_STEP : 1 / ZOOM_STEP, at);
    this.movedView();
  }

  #selectedPlace() {
    const point = this.point(this.state.selected);
    return point?.uv ? this.display.toView(point.uv) : this.display.middle;
  }

  #others() {
    return Object.values(window.sightlineXray).filter((view) => view !== this);
  }

  /** @param {boolean} on */
  #link(on) {
    for (const view of Object.values(window.sightlineXray)) {
      view.state.linked = on;
      view.chrome.press("link", on);
    }
    this.movedView();
  }

  displayChanged() {
    const { rotation, mirrored } = this.display;
    const { inverted, window: shown } = this.state;
    const seq = (this.undone.display = this.moves.number());
    this.emit({ type: "display", image: this.shownUrl, seq, rotation, mirrored, inverted, window: { ...shown } });
  }

  /** @param {string | null} id */
  select(id) {
    if (this.state.selected === id) return;
    this.state.selected = id;
    this.emit({ type: "select", id });
    this.canvas.invalidate("overlay");
  }

  /** The point under the pointer, or null: its name is shown.
   * @param {string | null} id */
  hover(id) {
    if (this.state.hovered === id) return;
    this.state.hovered = id;
    this.canvas.invalidate("overlay");
  }

  /** Draws the point at once; `type` tells the server the action: place, drag, drop or nudge.
   * @param {string} type
   * @param {string} id
   * @param {Pair} uv */
  move(type, id, uv) {
    const point = this.point(id);
    if (!point || !this.#onItsImage) return this.release();
    const onCurve = point.slides || (point.snapped && type !== "place");
    point.uv = this.display.clamp(onCurve ? this.following.slid(id, uv) : uv);
    this.undone.points.set(id, this.moves.push(type, id, point.uv, this.shownUrl));
    if (type !== "drag") this.#settled(/** @type {Placed} */ (point));
    this.canvas.invalidate("overlay");
    for (const follower of this.following.followers) follower.follow(id);
  }

  // Ends the current gesture without a message to the server.
  release() {
    this.#showDisplay();
    this.mergePoints();
    for (const follower of this.following.followers) follower.settle();
  }

  /** Points whose place here is not the server's word, and that place.
   * @returns {Map<string, Pair>} */
  get moved() {
    return new Map(this.placed.filter(({ id }) => this.#held(id)).map(({ id, uv }) => [id, uv]));
  }

  /** The point of an id; null: none.
   * @param {string | null} id */
  point(id) {
    return (id !== null && this.state.points.get(id)) || null;
  }

  /** @returns {Placed[]} */
  get placed() {
    return /** @type {Placed[]} */ ([...this.state.points.values()].filter((point) => point.uv));
  }

  /** All shapes, with the curves of points that are moving. */
  get shownShapes() {
    return [...this.matching.over(this.#layerShapes, this.following.moving), ...this.ruler.shapes];
  }

  get #layerShapes() {
    return [...this.state.layers.values()].flatMap((layer) => layer.shapes);
  }

  /** @param {string} id */
  remove(id) {
    this.emit({ type: "remove", id, image: this.shownUrl });
  }

  // The address of the image on the screen; null: none.
  get shownUrl() {
    return this.state.image?.url ?? null;
  }

  // The address of the newest message's image; null: none.
  get url() {
    return this.stream.url;
  }

  // Points can be placed and moved only over the image of the newest message.
  get #onItsImage() {
    return this.state.image !== null && this.shownUrl === this.url;
  }

  /** The click that places a point.
   * @param {Pair} place */
  placeAt(place) {
    const id = this.state.placing;
    if (id === null || !this.#onItsImage) return;
    const uv = this.aimed(place);
    if (!this.display.contains(uv)) {
      this.chrome.showLine(this.chrome.lost, this.texts.off_field);
      return;
    }
    this.move("place", id, uv);
    this.undone.placing = this.undone.points.get(id) ?? null;
    this.#showPlacing();
    this.select(id);
  }

  /** Where a click at `uv` places the point: on its curve, if it slides there.
   * @param {Pair} uv */
  aimed(uv) {
    const point = this.point(this.state.placing);
    return point?.slides ? this.following.slid(point.id, uv) : uv;
  }

  cancelPlacing() {
    const id = this.state.placing;
    const seq = (this.undone.placing = this.moves.number());
    this.#showPlacing();
    this.emit({ type: "cancel", id, seq });
  }

  /** Repeats an edit made before the connection broke; returns false if its point is gone.
   * @param {Move} move */
  resend({ type, id, uv }) {
    const point = this.point(id);
    if (!point) return false;
    point.uv = uv;
    this.undone.points.set(id, this.moves.push(type, id, uv, this.url));
    this.#showPoints();
    this.canvas.invalidate("overlay");
    return true;
  }

  /** @param {string} id */
  sayLost(id) {
    this.chrome.showLine(this.chrome.lost, this.texts.edit_lost.replace("{name}", this.#nameOf(id)));
  }

  // -------------------------------------------------------------------------------------------------- positions

  /** @param {Pair} uv */
  toScreen(uv) {
    const box = this.stage.getBoundingClientRect();
    const [x, y] = this.display.toView(uv);
    return [x + box.left, y + box.top];
  }

  /** @param {Pair} at */
  toImage([x, y]) {
    const box = this.stage.getBoundingClientRect();
    return this.display.toImage([x - box.left, y - box.top]);
  }

  // ------------------------------------------------------------------------------------------------------------ inside

  #actions() {
    return {
      fit: () => {
        this.display.fit();
        this.movedView();
      },
      link: () => this.#link(!this.state.linked),
      measure: () => this.setTool(this.state.tool === "measure" ? "pan" : "measure"),
      window: () => this.setTool(this.state.tool === "window" ? "pan" : "window"),
      invert: () => this.#changeDisplay(() => this.#setInverted(!this.state.inverted)),
      flip: () => this.#changeDisplay(() => this.display.flip()),
      rotate: () => this.#changeDisplay(() => this.display.turnClockwise()),
      /** @param {Window_} shown */
      preset: (shown) => this.#changeDisplay(() => this.setWindow(shown)),
      reset: () => this.#changeDisplay(() => this.#reset()),
      maximise: () => this.maximise(!this.state.maximised),
    };
  }

  /** Moved to the top level of the page: within its own box, later elements would cover it.
   * @param {boolean} on */
  maximise(on) {
    if (on === this.state.maximised) return;
    const focused = /** @type {HTMLElement} */ (document.activeElement);
    if (on) {
      this.root.replaceWith(this.place);
      document.body.append(this.root);
    } else {
      this.place.replaceWith(this.root);
    }
    if (this.root.contains(focused)) focused.focus({ preventScroll: true }); // a moved element loses the focus
    this.state.maximised = on;
    this.root.classList.toggle("xray-maximised", on);
    this.chrome.relabel("maximise", on ? "restore" : "maximise");
    this.chrome.press("maximise", on);
  }

  /** @param {() => void} change */
  #changeDisplay(change) {
    change();
    this.#turned();
    this.displayChanged();
  }

  #turned() {
    this.reading.showState();
    this.movedView();
  }

  #reset() {
    this.display.orient((360 - (this.word.head ?? 0)) % 360, false);
    this.display.fit();
    const { asked } = this.stream;
    if (asked) this.setWindow(asked.window);
    this.#setInverted(false);
  }

  /** @param {boolean} on */
  #setInverted(on) {
    this.state.inverted = on;
    this.canvas.invalidate("table");
    this.reading.showState();
  }

  /** @param {Tool} tool */
  setTool(tool) {
    this.state.tool = tool;
    this.ruler.end();
    this.lens = null;
    this.reading.showState();
    this.gestures.showCursor();
  }

  /** Take the pixels that arrived, or null where there is no image.
   * @param {Image | null} image */
  #takeImage(image) {
    this.state.image = image;
    if (image !== null) {
      this.age.arrived(image.url);
      this.display.setImage(image);
      this.#showDisplay();
      this.chrome.showLine(this.chrome.fault, "");
    }
    this.canvas.invalidate("table", "image", "overlay", "readout");
  }

  /** @param {string} message */
  #loadFailed(message) {
    this.chrome.showLine(this.chrome.fault, this.texts.load_failed);
    this.#report(message);
  }

  /** Hides the plan while the image is out of date.
   * @param {boolean} stale */
  #showStale(stale) {
    this.state.stale = stale;
    this.chrome.showLine(this.chrome.stale, stale ? this.texts.stale : "");
    this.canvas.invalidate("overlay");
  }

  // Another image ends the gesture on the one before.
  #letGo() {
    const [held, waiting] = [this.gestures.leaveImage(), this.moves.abandon()];
    const lost = held ?? waiting;
    this.undone = nothingUndone();
    this.ruler.end();
    if (lost !== null) this.sayLost(lost);
  }

  /** A move has ended: announce its position to screen readers, and clear the notice of an earlier loss.
   * @param {Placed} point */
  #settled(point) {
    this.#showPoints();
    this.chrome.say(this.reading.describe(point));
    this.chrome.showLine(this.chrome.lost, "");
  }

  /** @type {(sent: PointSent, before: Point | undefined) => Point} */
  #point({ id, label, uv, style, movable, snapped, slides }, before) {
    if (!STYLES[style]) this.#report(`point ${id}: unknown style ${JSON.stringify(style)}`);
    return {
      id,
      label: label || id,
      uv: before && (this.#held(id) || (snapped && this.following.moving.has(id))) ? before.uv : uv || null,
      style: STYLES[style] ? style : "aid",
      movable: movable !== false,
      snapped: Boolean(snapped),
      slides: Boolean(slides),
    };
  }

  /** @param {string} id */
  #held(id) {
    return this.state.dragging === id || this.undone.points.has(id);
  }

  /** @param {string} id */
  #dropPoint(id) {
    this.moves.forget(id);
    this.undone.points.delete(id);
    if (this.state.dragging === id) this.gestures.letGo();
    if (this.state.selected === id) this.state.selected = null;
    if (this.state.hovered === id) this.state.hovered = null;
  }

  /** @param {string} id */
  #nameOf(id) {
    return this.point(id)?.label ?? id;
  }

  #showPoints() {
    this.buttons.show(this.placed, (point) => this.reading.describe(point));
  }

  /** @param {string} id */
  focusPoint(id) {
    this.buttons.focus(id);
  }

  /** @param {string} message */
  #report(message) {
    this.emit({ type: "error", message });
  }

  #resize() {
    this.canvas.resize();
    this.gestures.viewChanged();
    this.movedView();
  }
}

/** Numbers of actions that are not acknowledged.
 * @returns {{ points: Map<string, number>, placing: number | null, display: number | null }} */
const nothingUndone = () => ({ points: new Map(), placing: null, display: null });
