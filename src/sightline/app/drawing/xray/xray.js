// The X-ray view: an image with layers of shapes, and points that a person places and moves. Uses no framework.
//
// The core holds the state and takes messages; others take the person's edits of points (xray_edits.js) and settings
// (xray_settings.js), draw (xray_canvas.js), listen (xray_gestures.js, xray_gestures.js), load images (xray_stream.js), say
// what is seen (xray_reading.js) and follow the other view (xray_matching.js).
// Coordinates are image pixels (see xray_display.js); the person's actions go out through `emit`.
//
// `word` is the content of the view by the server's newest message. A person's action is drawn over it at once;
// when the server acknowledges it, `word` replaces it.

import { Age, Stream } from "./xray_stream.js";
import { Canvas } from "./xray_canvas.js";
import { Chrome } from "./xray_chrome.js";
import { Crosshair, Reading, Ruler } from "./xray_reading.js";
import { Display } from "./xray_display.js";
import { Edits } from "./xray_edits.js";
import { Following, Matching } from "./xray_matching.js";
import { Gestures } from "./xray_gestures.js";
import { shapeFault } from "./xray_paint.js";
import { PointButtons } from "./xray_labels.js";
import { Settings } from "./xray_settings.js";

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Point} Point */
/** @typedef {import("./types").Placed} Placed */
/** @typedef {import("./types").Shape} Shape */
/** @typedef {import("./types").Picture} Picture */
/** @typedef {import("./types").Image} Image */
/** @typedef {import("./types").Window} Window_ */
/** @typedef {import("./types").Word} Word */
/** @typedef {import("./types").News} News */
/** @typedef {import("./types").Move} Move */
/** @typedef {import("./xray_settings.js").Tool} Tool */
/**
 * @typedef {{ image: Image | null, window: Window_, inverted: boolean, linked: boolean, stale: boolean,
 *   maximised: boolean, tool: Tool, placing: string | null, selected: string | null, hovered: string | null,
 *   dragging: string | null, points: Map<string, Point>, layers: Map<string, { shapes: Shape[] }> }} State
 */

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
  identity: "",
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
    this.edits = new Edits(this, keep);
    this.settings = new Settings(this);
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
    this.chrome = new Chrome(root, label, texts, this.settings.actions);
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
    this.named = new ResizeObserver(() => {
      this.chrome.measureName();
      this.canvas.invalidate("overlay");
    });
    this.named.observe(this.chrome.name);
    this.named.observe(this.chrome.tools);
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
    this.named.disconnect();
    window.removeEventListener("resize", this.resized);
    this.gestures.destroy();
    this.stream.end();
    this.age.end();
    this.canvas.end();
    if (window.sightlineXray[this.name] === this) delete window.sightlineXray[this.name];
  }

  // ------------------------------------------------------------------------------------------------ server messages

  /** Show this content; what it does not have is as in the message before. Returns false if a newer message is known.
   * `freshMs`: see `setFresh`.
   * @param {News & { freshMs: number | null }} message */
  show({ freshMs, ...news }) {
    if (news.version <= this.word.version) return false;
    const word = (this.word = { ...this.word, ...news });
    this.chrome.setLabel(word.label);
    this.chrome.showText(this.chrome.identity, word.identity);
    this.chrome.showLine(this.chrome.notice, word.notice);
    this.#showPicture(word.picture, freshMs);
    this.#showLayers(word.layers);
    this.matching.show(word.matching, this.#layerShapes, (message) => this.report(message));
    this.settings.show();
    this.edits.merge();
    this.edits.showPlacing();
    this.reading.showState();
    return true;
  }

  /** The action of this number is acknowledged: `word` replaces it.
   * @param {number} seq */
  acknowledge(seq) {
    this.edits.acknowledge(seq);
    this.settings.acknowledge(seq);
    this.release();
    this.edits.showPlacing();
  }

  // Discard unacknowledged actions.
  giveUp() {
    this.#discard();
    this.release();
    this.edits.showPlacing();
  }

  /** @type {(picture: Picture | null, freshMs: number | null) => void} */
  #showPicture(picture, freshMs) {
    const url = picture?.url ?? null;
    this.setFresh(url, freshMs);
    this.root.classList.toggle("xray-empty", !picture);
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
      if (faults.length) this.report(`layer ${name}: ${faults[0]}`);
      this.state.layers.set(name, { shapes: faults.length ? shapes.filter((shape) => !shapeFault(shape)) : shapes });
    }
    this.chrome.showLine(this.chrome.legend, this.#layerShapes.find(({ legend }) => legend)?.legend ?? "");
    this.canvas.invalidate("overlay");
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

  // Ends the current gesture without a message to the server.
  release() {
    this.settings.show();
    this.edits.merge();
    for (const follower of this.following.followers) follower.settle();
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

  // The address of the image on the screen; null: none.
  get shownUrl() {
    return this.state.image?.url ?? null;
  }

  // The address of the newest message's image; null: none.
  get url() {
    return this.stream.url;
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

  /** Take the pixels that arrived; null for a view without an image.
   * @param {Image | null} image */
  #takeImage(image) {
    this.state.image = image;
    if (image !== null) {
      this.age.arrived(image.url);
      this.display.setImage(image);
      this.settings.show();
      this.chrome.showLine(this.chrome.fault, "");
    }
    this.canvas.invalidate("table", "image", "overlay", "readout");
  }

  /** @param {string} message */
  #loadFailed(message) {
    this.chrome.showLine(this.chrome.fault, this.texts.load_failed);
    this.report(message);
  }

  /** Hides the plan while the image is out of date.
   * @param {boolean} stale */
  #showStale(stale) {
    this.state.stale = stale;
    this.chrome.showLine(this.chrome.stale, stale ? this.texts.stale : "");
    this.canvas.invalidate("image", "overlay"); // marks that stand still are painted otherwise too
  }

  // Another image ends the gesture on the one before.
  #letGo() {
    const [held, waiting] = [this.gestures.leaveImage(), this.edits.moves.abandon()];
    const lost = held ?? waiting;
    this.#discard();
    this.ruler.end();
    if (lost !== null) this.edits.sayLost(lost);
  }

  #discard() {
    this.edits.giveUp();
    this.settings.giveUp();
  }

  /** @param {string} id */
  focusPoint(id) {
    this.buttons.focus(id);
  }

  /** @param {string} message */
  report(message) {
    this.emit({ type: "error", message });
  }

  #resize() {
    this.canvas.resize();
    this.gestures.viewChanged();
    this.settings.movedView();
  }
}
