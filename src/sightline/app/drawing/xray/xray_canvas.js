// Draws a view: image, marks, texts and magnifier, in an animation frame and only what has changed.
//
// There is one canvas on the page, because each costs the browser a millisecond per frame; the image without marks, and
// the image with those that stand still, are on others, off the page.

import { COLOURS } from "colours";
import { ZOOM_MAX } from "./xray_display.js";
import { arrange, Labels, measureOn, paintTexts } from "./xray_labels.js";
import { hasDirection, paintCrosshair, paintDirection, paintPoint, paintShape, reaches, STYLES } from "./xray_paint.js";
import { Bitmap } from "./xray_stream.js";

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Point} Point */
/** @typedef {import("./types").Shape} Shape */
/** @typedef {{ key: object | string, paint: (context: CanvasRenderingContext2D) => void }} Mark */

/** @typedef {"table" | "image" | "overlay" | "readout"} Part table: the grey levels */

const FRAMES_KEPT = 2000;
const BREAK_MS = 250; // a longer gap between frames means that the person paused
const READ_MS = 100; // [ours] between readouts in a drag: nobody reads more, and each costs a layout
const CROSS = 24; // half the size of the keyboard's cross-hair
const TEXT_PX = 15; // CSS pixels of the text for which `unit` is 1

export class Canvas {
  /** @param {import("./xray.js").XrayCore} core */
  constructor(core) {
    this.core = core;
    this.ground = opaque(document.createElement("canvas"));
    this.behind = opaque(document.createElement("canvas")); // the image with the marks that stand still
    this.still = new Still();
    this.shown = opaque(core.chrome.canvas);
    this.picture = new Bitmap();
    this.dirty = { table: false, image: true, overlay: true, readout: true };
    this.draws = { table: 0, image: 0, overlay: 0 };
    /** @type {number[]} */
    this.frames = []; // ms between consecutive frames
    this.lastFrame = 0;
    this.lastRead = 0;
    /** @type {number | null} */
    this.reading = null; // timer of a readout that is put off
    /** @type {number | null} */
    this.request = null;
    /** @type {Pair} */
    this.density = [1, 1]; // device pixels per CSS pixel, across and down
    this.unit = 1; // CSS pixels per unit of the marks, which scale with the text
  }

  end() {
    if (this.request !== null) cancelAnimationFrame(this.request);
    if (this.reading !== null) clearTimeout(this.reading);
  }

  /** Draws these parts again in the next frame.
   * @param {...Part} parts */
  invalidate(...parts) {
    for (const part of parts) this.dirty[part] = true;
    this.request ??= requestAnimationFrame((now) => this.#frame(now));
  }

  /** The view or the screen has another size. */
  resize() {
    const { root, stage, display } = this.core;
    const { clientWidth, clientHeight } = stage;
    const ratio = window.devicePixelRatio || 1;
    const [wide, high] = [Math.max(Math.round(clientWidth * ratio), 1), Math.max(Math.round(clientHeight * ratio), 1)];
    for (const { canvas } of [this.ground, this.behind, this.shown]) Object.assign(canvas, { width: wide, height: high });
    this.density = [wide / Math.max(clientWidth, 1), high / Math.max(clientHeight, 1)];
    this.unit = parseFloat(getComputedStyle(root).fontSize) / TEXT_PX;
    display.setView(clientWidth, clientHeight);
  }

  /** @param {number} now */
  #frame(now) {
    this.request = null;
    const since = now - this.lastFrame;
    this.lastFrame = now;
    if (since < BREAK_MS) this.frames.push(since);
    if (this.frames.length > FRAMES_KEPT) this.frames.splice(0, FRAMES_KEPT / 2);
    const { table, image, overlay, readout } = this.dirty;
    this.dirty = { table: false, image: false, overlay: false, readout: false };
    if (table) this.#drawTable();
    if (image || table) this.#drawImage();
    if (image || table || overlay) this.#drawOverlay();
    if (readout || table) this.#read(now);
  }

  /** Shows the readout, in a drag at most every READ_MS.
   * @param {number} now */
  #read(now) {
    const left = this.core.state.dragging === null ? 0 : READ_MS - (now - this.lastRead);
    if (left > 0) {
      this.reading ??= setTimeout(() => {
        this.reading = null;
        this.invalidate("readout");
      }, left);
      return;
    }
    this.lastRead = now;
    this.core.reading.show();
  }

  #drawTable() {
    const { image, inverted, window: shown } = this.core.state;
    if (!image) return;
    this.draws.table++;
    this.picture.draw(image, shown, inverted);
  }

  #drawImage() {
    this.draws.image++;
    this.still.forget();
    const context = this.ground;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = COLOURS.stage;
    context.fillRect(0, 0, context.canvas.width, context.canvas.height);
    this.#paintBitmap(context, this.core.display.centre, this.core.display.middle, 1);
  }

  /** Draws the image with `uv` at position `at` of the view (CSS pixels), magnified `times` over the display's zoom.
   * @type {(context: CanvasRenderingContext2D, uv: Pair, at: Pair, times: number) => void} */
  #paintBitmap(context, uv, at, times) {
    const { state, display } = this.core;
    if (!state.image) return;
    const linear = display.linear().map((number) => number * times);
    this.picture.paint(context, linear, uv, at, this.density);
  }

  #drawOverlay() {
    this.draws.overlay++;
    const { core, shown: context } = this;
    /** @type {(uv: Pair) => Pair} */
    const toUnits = (uv) => {
      const [x, y] = core.display.toView(uv);
      return [x / this.unit, y / this.unit];
    };
    this.#paintAll(toUnits);
    this.#paintTexts(context, toUnits);
    if (core.crosshair.uv) paintCrosshair(context, toUnits(core.crosshair.uv), CROSS);
    const { lens } = core;
    let top = Infinity; // of the magnifier
    if (lens) {
      top = paintLens(context, lens, core.display, this.unit, {
        bitmap: (uv, at, times) => this.#paintBitmap(context, uv, at, times),
        units: () => this.#toUnits(context),
        marks: (toLens, zoom, box) => {
          const near = core.shownShapes.filter((shape) => reaches(shape, toLens, zoom, box));
          for (const { paint } of this.#marks(near, toLens, zoom, core.state.dragging)) paint(context);
        },
      });
    }
    core.stage.classList.toggle("xray-lens", lens !== null); // the focus ring would cover the magnifier
    core.stage.classList.toggle("xray-lens-top", top * this.unit < core.chrome.headBottom); // so would name and tools
    // The magnifier hides the buttons; while a point moves in the other view, none here has the focus.
    if (!lens && core.following.moving.size === 0) core.buttons.place(core.placed, (uv) => core.display.toView(uv));
  }

  /** @param {CanvasRenderingContext2D} context */
  #toUnits(context) {
    const [sx, sy] = this.density;
    context.setTransform(sx * this.unit, 0, 0, sy * this.unit, 0, 0);
  }

  /** Image and marks; while a point moves, only the marks that do not stand still are painted.
   * @param {(uv: Pair) => Pair} toUnits */
  #paintAll(toUnits) {
    const { core, ground, behind, shown } = this;
    const zoom = core.display.zoom / this.unit;
    const marks = this.#marks(core.shownShapes, toUnits, zoom, null);
    const moving = core.edits.moved.size > 0 || core.following.moving.size > 0;
    /** @type {(context: CanvasRenderingContext2D, below: CanvasRenderingContext2D, which: (mark: Mark) => boolean) => void} */
    const paint = (context, below, which) => {
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.drawImage(below.canvas, 0, 0);
      this.#toUnits(context);
      for (const mark of marks.filter(which)) mark.paint(context);
    };
    const still = this.still.of(
      marks.map(({ key }) => key),
      moving,
      (kept) => paint(behind, ground, ({ key }) => kept.has(key)),
    );
    paint(shown, still.size ? behind : ground, ({ key }) => !still.has(key));
    const aiming = core.point(core.state.placing);
    if (aiming?.slides && core.lens) {
      paintPoint(shown, { ...aiming, snapped: true }, toUnits(core.lens.uv), true); // it slides on its curve
    }
  }

  /** The marks of shapes and points in the order of painting. Without texts: those are painted once, and not in the
   * magnifier. `without`: a point that is not drawn.
   * @type {(shapes: Shape[], toUnits: (uv: Pair) => Pair, zoom: number, without: string | null) => Mark[]} */
  #marks(shapes, toUnits, zoom, without) {
    const { stale, selected } = this.core.state;
    const points = this.core.placed.filter(({ id }) => id !== without);
    return [
      ...shapes.map((shape) => ({
        key: shape,
        /** @param {CanvasRenderingContext2D} context */
        paint: (context) => paintShape(context, shape, toUnits, zoom, stale, this.#colourOf(shape)),
      })),
      ...shapes.filter((shape) => hasDirection(shape, stale)).map((shape) => ({
        key: shape.points, // of the same shape, but another key than its own
        /** @param {CanvasRenderingContext2D} context */
        paint: (context) => paintDirection(context, shape.points.map(toUnits)),
      })),
      ...points.map((point) => ({
        key: JSON.stringify([point, point.id === selected]),
        /** @param {CanvasRenderingContext2D} context */
        paint: (context) => paintPoint(context, point, toUnits(point.uv), point.id === selected),
      })),
    ];
  }

  /** @type {(context: CanvasRenderingContext2D, toUnits: (uv: Pair) => Pair) => void} */
  #paintTexts(context, toUnits) {
    const { core } = this;
    const { stale, selected, hovered, dragging } = core.state;
    const { viewWidth, viewHeight } = core.display;
    const labels = new Labels(measureOn(context), [
      viewWidth / this.unit,
      viewHeight / this.unit - TEXT_PX * core.chrome.footEm,
    ]);
    const [right, bottom] = core.chrome.nameCorner;
    labels.keepCorner([right / this.unit, bottom / this.unit]);
    arrange(
      labels,
      core.shownShapes
        .filter(({ style }) => !stale || !STYLES[style].plan)
        .map((shape) => [shape, shape.points.map(toUnits)]),
      core.placed.map((point) => [point, toUnits(point.uv)]),
      new Set([selected, hovered, dragging]),
      (id) => this.#curveOf(id),
    );
    paintTexts(context, labels.texts);
  }

  /** A curve has the name and the colour of its point.
   * @param {string} id */
  #curveOf(id) {
    const point = this.core.point(id);
    return point ? { name: point.label, colour: STYLES[point.style].colour } : null;
  }

  /** Ticks are all alike.
   * @param {Shape} shape */
  #colourOf({ of, shape }) {
    return of === undefined || shape === "ticks" ? null : (this.#curveOf(of)?.colour ?? null);
  }
}

/** @param {HTMLCanvasElement} canvas */
const opaque = (canvas) => /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { alpha: false }));

// Which marks stand still while a point moves: they are painted once, over the image, on a canvas off the page. Strokes
// are most of a frame's time.
/** @typedef {object | string} Key of a mark: another one once it must be painted otherwise */

/** @type {Set<Key>} */
const NONE = new Set();

export class Still {
  constructor() {
    /** @type {Set<Key>} */
    this.before = new Set(); // of the previous frame
    /** @type {Set<Key> | null} */
    this.painted = null; // on the canvas; null: it holds nothing of use
  }

  /** The marks, of all `keys` in a frame, that lie on the canvas. A mark counts as still if the previous frame had it.
   * `moving`: a point moves; else none is kept, so that all are painted in their order. `paint(still)` clears the
   * canvas and paints these marks on it.
   * @param {Key[]} keys
   * @param {boolean} moving
   * @param {(still: Set<Key>) => void} paint */
  of(keys, moving, paint) {
    const now = new Set(keys);
    if (!moving) this.painted = null;
    else if (!this.painted || [...this.painted].some((key) => !now.has(key))) {
      this.painted = new Set(keys.filter((key) => this.before.has(key)));
      paint(this.painted);
    }
    this.before = now;
    return this.painted ?? NONE;
  }

  /** The image below has changed, or how marks are painted. */
  forget() {
    this.painted = null;
  }
}

// The round magnifier above the pointer (below it at the upper edge), with a cross-hair at its position.
const TIMES = 4;
const RADIUS = 84; // CSS pixels
const CLEAR = 44; // CSS pixels between its rim and the pointer

/** Returns the upper edge of its box, in the marks' units. `lens`: {uv, at}, the pixel in its middle and the pointer's position in the view. `paint`: bitmap(uv, at, times),
 * units() sets the context's units, marks(toUnits, zoom, box) paints
 * those that show in a box.
 * @param {CanvasRenderingContext2D} context
 * @param {{ uv: Pair, at: Pair }} lens
 * @param {import("./xray_display.js").Display} display
 * @param {number} unit
 * @param {{ bitmap: (uv: Pair, at: Pair, times: number) => void, units: () => void,
 *   marks: (toUnits: (uv: Pair) => Pair, zoom: number, box: { middle: number[], reach: number }) => void }} paint */
export function paintLens(context, { uv, at }, display, unit, paint) {
  const radius = RADIUS * unit;
  const clear = radius + CLEAR * unit;
  const x = Math.min(Math.max(at[0], radius + 4), display.viewWidth - radius - 4);
  const y = at[1] - clear - radius > 0 ? at[1] - clear : at[1] + clear;
  const times = Math.max(Math.min(TIMES, ZOOM_MAX / display.zoom), 1);
  const middle = [x / unit, y / unit];
  const [px, py] = display.toView(uv);
  /** @type {(place: Pair) => Pair} */
  const toUnits = (place) => {
    const [qx, qy] = display.toView(place);
    return [middle[0] + ((qx - px) * times) / unit, middle[1] + ((qy - py) * times) / unit];
  };
  const rim = () => {
    context.beginPath();
    context.arc(middle[0], middle[1], RADIUS, 0, 2 * Math.PI);
  };
  context.save();
  rim();
  context.fillStyle = COLOURS.raised; // beside the image: black would look like a part of it
  context.fill();
  context.clip();
  paint.bitmap(uv, [x, y], times);
  paint.units();
  paint.marks(toUnits, (display.zoom * times) / unit, { middle, reach: RADIUS });
  paintCrosshair(context, middle, RADIUS);
  context.restore();
  rim();
  for (const { width, colour } of [{ width: 5, colour: COLOURS.stage }, { width: 2, colour: COLOURS.text }]) {
    context.lineWidth = width;
    context.strokeStyle = colour;
    context.stroke();
  }
  return middle[1] - RADIUS;
}
