// Painting of shapes and points: a table of named styles, and a painter for each shape. Texts: xray_labels.js.
//
// Everything is painted in CSS pixels of the view, with `toView` mapping image pixels to them: lines and marks keep
// their size on screen at every zoom. No meaning depends on colour alone: marks differ by shape, lines by dashes.

import { COLOURS } from "colours";

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Shape} Shape */
/** @typedef {CanvasRenderingContext2D} Context */
/** How something is drawn. `plan`: hidden while the image is stale; `fill`: opacity of an area; `arrow`: a band's
 * direction is shown.
 * @typedef {{ colour: string, width: number, mark?: string, dash?: number[], fill?: number, plan?: boolean,
 *   arrow?: boolean }} Look */
/** @typedef {(uv: Pair) => Pair} ToView */

export const CASING = "rgba(5, 8, 11, 0.86)"; // under every line, because X-ray images may be white or black

/** An edge is measured more finely than a pixel, and thin.
 * @type {Record<string, Look>} */
export const STYLES = {
  "bead-good": { colour: COLOURS.green, width: 2, mark: "ring" },
  "bead-warn": { colour: COLOURS.orange, width: 2, mark: "ring", dash: [4, 3] },
  "bead-bad": { colour: COLOURS.vermillion, width: 2.5, mark: "ring-cross" },
  rejected: { colour: COLOURS.quiet, width: 2, mark: "cross" },
  curve: { colour: COLOURS.sky, width: 2.5, plan: true },
  "curve-band": { colour: COLOURS.sky, width: 1, fill: 0.2, plan: true },
  tick: { colour: COLOURS.text, width: 1.5, plan: true },
  wire: { colour: COLOURS.yellow, width: 3, fill: 0.6, plan: true, arrow: true },
  corridor: { colour: COLOURS.yellow, width: 2, fill: 0.16, dash: [8, 5], plan: true },
  plan: { colour: COLOURS.yellow, width: 2, fill: 0.14, dash: [10, 6], plan: true },
  implant: { colour: COLOURS.text, width: 1.25, fill: 0.06, plan: true },
  thread: { colour: COLOURS.text, width: 1.25, fill: 0.12, dash: [2, 3], plan: true },
  edge: { colour: COLOURS.green, width: 1.25 },
  deviation: { colour: COLOURS.text, width: 2.5, mark: "arrow" },
  entry: { colour: COLOURS.sky, width: 2, mark: "ring" },
  end: { colour: COLOURS.purple, width: 2, mark: "diamond" },
  aid: { colour: COLOURS.quiet, width: 1.5, fill: 0.12, dash: [5, 5], mark: "ring" },
  landmark: { colour: COLOURS.orange, width: 2, fill: 0.14, mark: "square" },
  focus: { colour: COLOURS.text, width: 3, fill: 0.14, mark: "ring" },
  found: { colour: COLOURS.green, width: 3, fill: 0.2, mark: "ring-cross" },
  stale: { colour: COLOURS.quiet, width: 1.5, fill: 0.08, dash: [2, 6], mark: "ring" },
};

const ENDS = [COLOURS.sky, COLOURS.yellow, COLOURS.vermillion];
const SCALE = ENDS.map((hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)));
const MARK_RADIUS = 7; // CSS pixels, for marks without a size in the image
export const POINT_RADIUS = 11;
const ARROW = 15; // CSS pixels, an arrow head's sides
const ARROW_MIN = 8; // [ours] CSS pixels, those of a short arrow
const OVER = 20; // CSS pixels that a mark reaches from its place at most: those of an arrow head, with its stroke
const THIN = 0.05; // [ours] CSS pixels: less than an edge's smoothing shows

/** The colour of a residual: 0 sky blue, 0.5 yellow, 1 vermillion; blue to yellow survives every colour blindness.
 * @param {number} value */
export function residualColour(value) {
  const at = Math.min(Math.max(value, 0), 1) * (SCALE.length - 1);
  const low = Math.min(Math.floor(at), SCALE.length - 2);
  const mixed = SCALE[low].map((from, channel) => Math.round(from + (SCALE[low + 1][channel] - from) * (at - low)));
  return `rgb(${mixed.join(", ")})`;
}

/** @template Value
 * @param {Value | null | undefined} value
 * @returns {value is Value} */
const given = (value) => value !== undefined && value !== null;
/** @type {(list: number | number[] | undefined, index: number) => number} */
const each = (list, index) => (Array.isArray(list) ? list[index] : (list ?? 0));

/** @type {(context: Context, places: Pair[], closed: boolean) => void} */
function path(context, places, closed) {
  context.beginPath();
  thinned(places).forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
  if (closed) context.closePath();
}

/** A polyline without the corners that lie within THIN of it all the same, by Douglas and Peucker: to stroke a curve of
 * a hundred corners takes the browser milliseconds.
 * @param {Pair[]} places
 * @returns {Pair[]} */
export function thinned(places) {
  const kept = places.map((_, index) => index === 0 || index === places.length - 1);
  const open = [[0, places.length - 1]];
  for (let part = open.pop(); part; part = open.pop()) {
    const [first, last] = part;
    let [most, at] = [THIN, first];
    for (let index = first + 1; index < last; index++) {
      const away = distanceToSegment(places[index], places[first], places[last]);
      if (away > most) [most, at] = [away, index];
    }
    if (at === first) continue;
    kept[at] = true;
    open.push([first, at], [at, last]);
  }
  return places.filter((_, index) => kept[index]);
}

/** Strokes the path twice: dark and wider below, coloured above.
 * @type {(context: Context, look: Look) => void} */
function strokeCased(context, look) {
  context.lineJoin = "round";
  context.lineCap = "round";
  context.setLineDash([]);
  context.lineWidth = look.width + 2.5;
  context.strokeStyle = CASING;
  context.stroke();
  context.setLineDash(look.dash || []);
  context.lineWidth = look.width;
  context.strokeStyle = look.colour;
  context.stroke();
  context.setLineDash([]);
}

/** @type {(context: Context, look: Look) => void} */
function fillArea(context, look) {
  context.globalAlpha = look.fill || 0.15;
  context.fillStyle = look.colour;
  context.fill();
  context.globalAlpha = 1;
}

/** @type {(context: Context, place: Pair, arm: number) => void} */
function crossPath(context, [x, y], arm) {
  context.moveTo(x - arm, y - arm);
  context.lineTo(x + arm, y + arm);
  context.moveTo(x - arm, y + arm);
  context.lineTo(x + arm, y - arm);
}

/** @type {(context: Context, place: Pair, radius: number, look: Look) => void} */
function paintMark(context, place, radius, look) {
  context.beginPath();
  if (look.mark !== "cross") {
    context.arc(place[0], place[1], radius, 0, 2 * Math.PI);
    strokeCased(context, look);
    context.beginPath();
  }
  if (look.mark === "cross" || look.mark === "ring-cross") {
    crossPath(context, place, radius * 0.6);
    strokeCased(context, { ...look, dash: undefined });
  }
}

/** Unit normals of a polyline at its corners, in the view.
 * @type {(places: Pair[]) => Pair[]} */
export function normals(places) {
  return places.map((_, index) => {
    const [x0, y0] = places[Math.max(index - 1, 0)];
    const [x1, y1] = places[Math.min(index + 1, places.length - 1)];
    const length = Math.hypot(x1 - x0, y1 - y0) || 1;
    return [(y0 - y1) / length, (x1 - x0) / length];
  });
}

/** @type {(context: Context, from: Pair, tip: Pair, size: number) => void} */
function headPath(context, from, tip, size) {
  const angle = Math.atan2(tip[1] - from[1], tip[0] - from[0]);
  /** @param {number} turn */
  const back = (turn) => [tip[0] - size * Math.cos(angle + turn), tip[1] - size * Math.sin(angle + turn)];
  const [left, right] = [back(0.55), back(-0.55)];
  context.moveTo(left[0], left[1]);
  context.lineTo(tip[0], tip[1]);
  context.lineTo(right[0], right[1]);
}

/** Whether a shape has an arrow head in its middle; it is painted after all shapes, so that the drilled part of a wire
 * does not cover it.
 * @type {(shape: Shape, staleImage: boolean) => boolean} */
export const hasDirection = ({ style, points }, staleImage) =>
  Boolean(STYLES[style].arrow) && points.length > 0 && !(staleImage && STYLES[style].plan);

/** An arrow head in the middle of a wire, where it is long enough to have one.
 * @type {(context: Context, places: Pair[]) => void} */
export function paintDirection(context, places) {
  const [first, last] = [places[0], places[places.length - 1]];
  const [dx, dy] = [last[0] - first[0], last[1] - first[1]];
  const length = Math.hypot(dx, dy);
  if (length < 5 * ARROW) return;
  /** @type {Pair} */
  const tip = [first[0] + dx * 0.5 + (dx / length) * ARROW * 0.5, first[1] + dy * 0.5 + (dy / length) * ARROW * 0.5];
  context.beginPath();
  headPath(context, first, tip, ARROW);
  strokeCased(context, { colour: COLOURS.text, width: 3 });
}

/** @type {(places: Pair[], shape: Shape, zoom: number) => [Pair[], Pair[]]} */
function bandEdges(places, shape, zoom) {
  const across = normals(places);
  /** @type {(sign: number) => Pair[]} */
  const side = (sign) =>
    places.map(([x, y], index) => {
      const half = sign * each(shape.halfWidth, index) * zoom;
      return [x + across[index][0] * half, y + across[index][1] * half];
    });
  return [side(1), side(-1)];
}

/** @type {Record<string, (context: Context, places: Pair[], shape: Shape, look: Look, zoom: number) => void>} */
const PAINTERS = {
  line(context, places, shape, look) {
    path(context, places, false);
    strokeCased(context, look);
  },
  polygon(context, places, shape, look) {
    path(context, places, true);
    fillArea(context, look);
    strokeCased(context, look);
  },
  circle(context, places, shape, look, zoom) {
    const shown = given(shape.value) ? { ...look, colour: residualColour(shape.value) } : look;
    places.forEach((place, index) => {
      const radius = given(shape.radius) ? Math.max(each(shape.radius, index) * zoom, 3) : MARK_RADIUS;
      paintMark(context, place, radius, shown);
    });
  },
  cross(context, places, shape, look) {
    context.beginPath();
    places.forEach((place) => crossPath(context, place, 5));
    strokeCased(context, { ...look, dash: undefined });
  },
  dots(context, places, shape, look) {
    for (const { radius, colour } of [{ radius: 4.5, colour: CASING }, { radius: 3, colour: look.colour }]) {
      context.fillStyle = colour;
      places.forEach(([x, y]) => {
        context.beginPath();
        context.arc(x, y, radius, 0, 2 * Math.PI);
        context.fill();
      });
    }
  },
  band(context, places, shape, look, zoom) {
    const [left, right] = bandEdges(places, shape, zoom);
    path(context, [...left, ...right.reverse()], true);
    fillArea(context, look);
    strokeCased(context, { ...look, width: 1.25 }); // thinner than a line, because it matters less
  },
  arrow(context, places, shape, look) {
    const [tail, tip] = [places[0], places[places.length - 1]];
    const length = Math.hypot(tip[0] - tail[0], tip[1] - tail[1]);
    path(context, [tail, tip], false);
    headPath(context, tail, tip, Math.min(Math.max(0.6 * length, ARROW_MIN), ARROW)); // the tail stays visible
    strokeCased(context, look);
  },
  text() {}, // a label alone
  ticks(context, places, shape, look) {
    const across = normals(places);
    context.beginPath();
    places.forEach(([x, y], index) => {
      const [nx, ny] = across[index];
      context.moveTo(x - nx * 7, y - ny * 7);
      context.lineTo(x + nx * 7, y + ny * 7);
    });
    strokeCased(context, { ...look, dash: undefined });
  },
};

/** The error in a shape as text; null if it can be painted.
 * @param {Shape} shape
 * @returns {string | null} */
export function shapeFault(shape) {
  if (!shape || !PAINTERS[shape.shape]) return `unknown shape ${JSON.stringify(shape?.shape)}`;
  if (!STYLES[shape.style]) return `unknown style ${JSON.stringify(shape.style)}`;
  /** @param {unknown} pair */
  const finite = (pair) => Array.isArray(pair) && pair.length === 2 && pair.every(Number.isFinite);
  if (!Array.isArray(shape.points) || !shape.points.every(finite)) return `${shape.shape} with points that are not numbers`;
  if (shape.shape === "band" && !given(shape.halfWidth)) return "band without halfWidth";
  return null;
}

/** `colour`: instead of its style's; a curve has the colour of its point.
 * @type {(context: Context, shape: Shape, toView: ToView, zoom: number, staleImage: boolean, colour: string | null) => void} */
export function paintShape(context, shape, toView, zoom, staleImage, colour) {
  const look = colour ? { ...STYLES[shape.style], colour } : STYLES[shape.style];
  if (shape.points.length === 0 || (staleImage && look.plan)) return;
  const places = shape.points.map(toView);
  PAINTERS[shape.shape](context, places, shape, look, zoom);
}

/** Whether a shape may show within `reach` of the middle of a box, in CSS pixels: whether its bounding box does.
 * @type {(shape: Shape, toView: ToView, zoom: number, box: { middle: number[], reach: number }) => boolean} */
export function reaches(shape, toView, zoom, { middle, reach }) {
  const places = shape.points.map(toView);
  const wide = [shape.halfWidth, shape.radius].flat().map((size) => (size ?? 0) * zoom);
  const beyond = reach + Math.max(...wide, 0) + OVER;
  return [0, 1].every((axis) => {
    const along = places.map((place) => place[axis] - middle[axis]);
    return Math.min(...along) < beyond && Math.max(...along) > -beyond;
  });
}

/** Distance in CSS pixels from `at` to the shape, for the tooltip.
 * @type {(shape: Shape, toView: ToView, zoom: number, at: Pair) => number} */
export function shapeDistance(shape, toView, zoom, at) {
  const places = shape.points.map(toView);
  const distances = places.map(([x, y], index) => {
    const away = Math.hypot(x - at[0], y - at[1]);
    return given(shape.radius) ? Math.max(away - each(shape.radius, index) * zoom, 0) : away;
  });
  if (["line", "polygon", "band", "ticks", "arrow"].includes(shape.shape)) {
    for (let index = 1; index < places.length; index++) {
      distances.push(distanceToSegment(at, places[index - 1], places[index]));
    }
  }
  return Math.min(...distances, Infinity);
}

/** @type {(at: Pair, from: Pair, to: Pair) => number} */
function distanceToSegment([x, y], [x0, y0], [x1, y1]) {
  const [dx, dy] = [x1 - x0, y1 - y0];
  const along = ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy || 1);
  const t = Math.min(Math.max(along, 0), 1);
  return Math.hypot(x - x0 - t * dx, y - y0 - t * dy);
}

/** A pick: an open mark, so that its pixel stays visible. A free point has the arms of a cross-hair; one on its curve
 * has none, because the curve passes through it.
 * @type {(context: Context, point: import("./types").Point, at: Pair, selected: boolean) => void} */
export function paintPoint(context, point, [x, y], selected) {
  const look = STYLES[point.style];
  const radius = selected ? POINT_RADIUS + 2 : POINT_RADIUS;
  context.beginPath();
  if (look.mark === "diamond" || look.mark === "square") {
    const reach = radius * 1.25;
    const turn = look.mark === "square" ? Math.PI / 4 : 0;
    const corners = [0, 1, 2, 3].map((k) => (k * Math.PI) / 2 + turn);
    path(context, corners.map((angle) => [x + reach * Math.cos(angle), y + reach * Math.sin(angle)]), true);
  } else {
    context.arc(x, y, radius, 0, 2 * Math.PI);
  }
  for (const [dx, dy] of point.snapped ? [] : [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + dx * 4, y + dy * 4);
    context.lineTo(x + dx * (radius + 5), y + dy * (radius + 5));
  }
  strokeCased(context, { ...look, width: selected ? 2.5 : 2, dash: point.movable ? undefined : [3, 3] });
  context.fillStyle = look.colour;
  context.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
}

/** @type {(context: CanvasRenderingContext2D, at: number[], radius: number) => void} */
export function paintCrosshair(context, [x, y], radius) {
  context.beginPath();
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + dx * 6, y + dy * 6);
    context.lineTo(x + dx * radius, y + dy * radius);
  }
  strokeCased(context, { colour: COLOURS.yellow, width: 1 });
}
