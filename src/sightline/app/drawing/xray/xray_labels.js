// Where texts stand over an image: none over another, over a tick or over a point.
//
// Texts are placed in the order of their importance. One without room is left out; only a point that a person hovers
// over or has selected always has its name.

import { COLOURS } from "colours";
import { CASING, normals, POINT_RADIUS } from "./xray_paint.js";

/** @typedef {[number, number]} Pair */
/** @typedef {{ left: number, right: number, top: number, bottom: number }} Box */
/** @typedef {import("./types").Placed} Placed */

/** @typedef {{ text: string, at: Pair, colour: string }} Text `at`: its middle */

const FONT = '600 14px Roboto, system-ui, "Segoe UI", "DejaVu Sans", sans-serif';
const HALF = 9; // half the height of a text, CSS pixels
const AWAY = POINT_RADIUS + 9; // from a point's middle to its name
const TICK = 7; // half a tick's length
const GAP = 2; // between a text and a tick
const LINE = 3; // kept free about a line's samples
const EVERY = 5; // samples of a curve between the places tried for its name

/** @type {(middle: Pair, width: number, half: number) => Box} */
const boxAbout = ([x, y], width, half) => ({ left: x - width / 2, right: x + width / 2, top: y - half, bottom: y + half });
/** @type {(a: Box, b: Box) => boolean} */
const overlap = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;

export class Labels {
  /** `measure(text)`: width of a text; `size`: of the view; all in CSS pixels.
   * @param {(text: string) => number} measure
   * @param {Pair} size */
  constructor(measure, size) {
    this.measure = measure;
    this.size = size;
    /** @type {Box[]} */
    this.taken = [];
    /** @type {Text[]} */
    this.texts = [];
  }

  /** Whether a place is in the view.
   * @param {Pair} at */
  shows([x, y]) {
    return x >= 0 && y >= 0 && x <= this.size[0] && y <= this.size[1];
  }

  /** Nothing is written here.
   * @param {Pair} middle
   * @param {number} reach */
  keepFree(middle, reach) {
    this.taken.push(boxAbout(middle, 2 * reach, reach));
  }

  /** Nothing is written in the corner before this point.
   * @param {Pair} corner */
  keepCorner([right, bottom]) {
    this.taken.push({ left: 0, right, top: 0, bottom });
  }

  /** A text at the first free one of these places (its middle); returns whether there is one. `always`: where none is
   * free, at the first one in the view.
   * @param {string} text
   * @param {Pair[]} places
   * @param {{ always?: boolean, colour?: string }} [how] */
  write(text, places, how = {}) {
    const { always = false, colour = COLOURS.text } = how;
    const width = this.measure(text);
    const boxes = places.map((place) => ({ at: place, box: boxAbout(place, width, HALF) }));
    const within = boxes.filter(({ box }) => this.#isWithin(box));
    const free = within.find(({ box }) => !this.taken.some((one) => overlap(one, box)));
    const chosen = free || (always ? within[0] || boxes[0] : null);
    if (!chosen) return false;
    this.taken.push(chosen.box);
    this.texts.push({ text, at: chosen.at, colour });
    return true;
  }

  /** The name of a point beside it, above it or below it.
   * @param {string} text
   * @param {Pair} at
   * @param {{ always?: boolean }} [how] */
  writeBeside(text, [x, y], how) {
    const width = this.measure(text);
    const across = AWAY + width / 2;
    const corners = [-1, 1].flatMap((down) => [1, -1].map((side) => [x + side * across, y + down * (POINT_RADIUS + 3)]));
    const centred = Math.min(Math.max(x, width / 2 + 3), this.size[0] - width / 2 - 3);
    const over = [-2.4, 2.4, -4, 4].map((times) => [centred, y + times * POINT_RADIUS]);
    return this.write(text, /** @type {Pair[]} */ ([...corners, ...over]), how);
  }

  /** @param {Box} box */
  #isWithin(box) {
    const [width, height] = this.size;
    return box.left > 2 && box.top > 2 && box.right < width - 2 && box.bottom < height - 2;
  }
}

/** Arranges the texts over an image.
 * @param {Labels} labels
 * @param {[import("./types").Shape, Pair[]][]} shapes with their places in the view
 * @param {[import("./types").Point, Pair][]} points with theirs
 * @param {Set<string | null>} named ids of the points whose names are shown
 * @param {(id: string) => { name: string, colour: string } | null} curveOf what a point's curve is called */
export function arrange(labels, shapes, points, named, curveOf) {
  for (const [, at] of points) labels.keepFree(at, POINT_RADIUS);
  for (const [{ shape }, places] of shapes) {
    if (shape !== "ticks" && shape !== "line") continue;
    for (const place of places) labels.keepFree(place, shape === "ticks" ? TICK : LINE);
  }
  for (const [point, at] of points) { // the name of one outside the view would stand beside another one
    if (named.has(point.id) && labels.shows(at)) labels.writeBeside(point.label, at, { always: true });
  }
  for (const [{ shape, of }, places] of shapes) {
    const curve = shape === "line" && of !== undefined ? curveOf(of) : null;
    if (curve) labels.write(curve.name, alongside(places, labels.measure(curve.name)), { colour: curve.colour });
  }
  for (const [{ shape, label }, places] of shapes) {
    if (shape === "ticks") writeNumbers(labels, Array.isArray(label) ? label : [], places);
    else if (typeof label !== "string" || places.length === 0) continue;
    else if (shape === "text") for (const place of places) labels.write(label, [place], { always: true });
    else if (labels.shows(places[places.length - 1])) labels.writeBeside(label, places[places.length - 1]);
  }
}

/** @type {(labels: Labels, numbers: string[], places: Pair[]) => void} */
function writeNumbers(labels, numbers, places) {
  const across = normals(places);
  places.forEach((place, k) => {
    if (numbers[k]) labels.write(numbers[k], beside(place, across[k], labels.measure(numbers[k])));
  });
}

/** Places beside a line for its name, from its ends inwards.
 * @type {(places: Pair[], width: number) => Pair[]} */
function alongside(places, width) {
  const across = normals(places);
  const samples = [...places.keys()].filter((k) => k % EVERY === 0);
  const inwards = samples.flatMap((_, n) => [samples[n], samples[samples.length - 1 - n]]).slice(0, samples.length);
  return inwards.flatMap((k) => beside(places[k], across[k], width));
}

/** Both places of a text of this width that just clears the ticks of a line with this normal.
 * @type {(place: Pair, normal: Pair, width: number) => Pair[]} */
function beside([x, y], [nx, ny], width) {
  const away = Math.abs(nx) * (width / 2 + TICK) + Math.abs(ny) * (HALF + TICK) + GAP;
  return [[x + nx * away, y + ny * away], [x - nx * away, y - ny * away]];
}

/** Every colour used is 4.5:1 on the casing, whatever the image is below.
 * @param {CanvasRenderingContext2D} context
 * @param {Text[]} texts */
export function paintTexts(context, texts) {
  context.font = FONT;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.lineWidth = 4;
  context.strokeStyle = CASING;
  for (const { text, at, colour } of texts) {
    context.fillStyle = colour;
    context.strokeText(text, at[0], at[1]);
    context.fillText(text, at[0], at[1]);
  }
}

/** @type {(context: CanvasRenderingContext2D) => (text: string) => number} */
export const measureOn = (context) => {
  context.font = FONT; // once: to read it takes longer than to measure a text
  return (text) => context.measureText(text).width;
};

// A button for each placed point, for the tab key and screen readers.
export class PointButtons {
  /** `holder`: the element that holds them; `onFocus(id)` hears which one has the focus.
   * @param {HTMLElement} holder
   * @param {(id: string) => void} onFocus */
  constructor(holder, onFocus) {
    this.holder = holder;
    this.onFocus = onFocus;
    /** @type {WeakMap<HTMLElement, string>} */
    this.placed = new WeakMap(); // the transform that each has
  }

  /** One for each of these points, named by `describe(point)`.
   * @param {Placed[]} points
   * @param {(point: Placed) => string} describe */
  show(points, describe) {
    const wanted = new Set(points.map((point) => point.id));
    for (const button of this.#all) if (!wanted.has(button.dataset.id ?? "")) button.remove();
    const present = new Map(this.#all.map((button) => [button.dataset.id, button]));
    for (const point of points) {
      const button = present.get(point.id) || this.#inserted(point.id);
      button.setAttribute("aria-label", describe(point));
    }
  }

  /** Moves them to the places of these points in the view, `where(uv)` in CSS pixels.
   * @param {Placed[]} points
   * @param {(uv: Pair) => Pair} where */
  place(points, where) {
    const places = new Map(points.map(({ id, uv }) => [id, uv]));
    for (const button of this.#all) {
      const uv = places.get(button.dataset.id ?? "");
      if (!uv) continue;
      const [x, y] = where(uv);
      const transform = `translate(${x}px, ${y}px)`;
      if (this.placed.get(button) === transform) continue;
      this.placed.set(button, transform);
      button.style.transform = transform;
    }
  }

  /** @param {string} id */
  focus(id) {
    const button = this.#all.find((each) => each.dataset.id === id);
    if (button) button.focus({ preventScroll: true });
  }

  get #all() {
    return /** @type {HTMLElement[]} */ ([...this.holder.children]);
  }

  /** @param {string} id */
  #inserted(id) {
    const button = document.createElement("button");
    button.type = "button";
    button.dataset.id = id;
    button.dataset.testid = `point-${id}`;
    button.addEventListener("focus", () => this.onFocus(id));
    this.holder.append(button);
    return button;
  }
}
