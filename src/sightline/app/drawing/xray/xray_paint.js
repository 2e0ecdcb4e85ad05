// Painting of shapes and points: a table of named styles, and a painter for each shape.
//
// Everything is painted in CSS pixels of the view, with `toView` mapping image pixels to them: lines and marks keep
// their size on screen at every zoom. No meaning depends on colour alone: beads differ by marks, lines by dashes.

import { COLOURS } from "colours";

const CASING = "rgba(5, 8, 11, 0.86)"; // under every line, because X-ray images may be white or black

const FONT = '600 14px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';

// plan: hidden while the image is stale. fill: opacity of an area.
export const STYLES = {
  "bead-good": { colour: COLOURS.green, width: 2, mark: "ring" },
  "bead-warn": { colour: COLOURS.orange, width: 2, mark: "ring", dash: [4, 3] },
  "bead-bad": { colour: COLOURS.vermillion, width: 2.5, mark: "ring-cross" },
  rejected: { colour: COLOURS.quiet, width: 2, mark: "cross" },
  curve: { colour: COLOURS.sky, width: 2.5, plan: true },
  "curve-band": { colour: COLOURS.sky, width: 1, fill: 0.2, plan: true },
  tick: { colour: COLOURS.text, width: 1.5, plan: true },
  wire: { colour: COLOURS.yellow, width: 3, fill: 0.6, plan: true },
  corridor: { colour: COLOURS.purple, width: 2, fill: 0.24, dash: [8, 5], plan: true },
  plan: { colour: COLOURS.yellow, width: 2, fill: 0.14, dash: [2, 4], plan: true },
  aid: { colour: COLOURS.quiet, width: 1.5, fill: 0.12, dash: [5, 5], silent: true },
  landmark: { colour: COLOURS.orange, width: 2, fill: 0.14, mark: "ring" },
  focus: { colour: COLOURS.text, width: 3, fill: 0.14, mark: "ring" },
  found: { colour: COLOURS.green, width: 3, fill: 0.2, mark: "ring-cross" },
  stale: { colour: COLOURS.quiet, width: 1.5, fill: 0.08, dash: [2, 6], mark: "ring" },
};

const ENDS = [COLOURS.sky, COLOURS.yellow, COLOURS.vermillion];
const SCALE = ENDS.map((hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)));
const MARK_RADIUS = 7; // CSS pixels, for marks without a size in the image
const POINT_RADIUS = 11;

// The colour of a residual: 0 sky blue, 0.5 yellow, 1 vermillion; blue to yellow survives every colour blindness.
export function residualColour(value) {
  const at = Math.min(Math.max(value, 0), 1) * (SCALE.length - 1);
  const low = Math.min(Math.floor(at), SCALE.length - 2);
  const mixed = SCALE[low].map((from, channel) => Math.round(from + (SCALE[low + 1][channel] - from) * (at - low)));
  return `rgb(${mixed.join(", ")})`;
}

const given = (value) => value !== undefined && value !== null;
const each = (list, index) => (Array.isArray(list) ? list[index] : list);

function path(context, places, closed) {
  context.beginPath();
  places.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
  if (closed) context.closePath();
}

// Strokes the path twice: dark and wider below, coloured above.
function strokeCased(context, look) {
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

function fillArea(context, look) {
  context.globalAlpha = look.fill || 0.15;
  context.fillStyle = look.colour;
  context.fill();
  context.globalAlpha = 1;
}

// White in every style: 4.5:1 on its casing whatever the image is below.
function paintText(context, text, [x, y], align = "left") {
  context.font = FONT;
  context.textAlign = align;
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.lineWidth = 4;
  context.strokeStyle = CASING;
  context.strokeText(text, x, y);
  context.fillStyle = COLOURS.text;
  context.fillText(text, x, y);
}

function crossPath(context, [x, y], arm) {
  context.moveTo(x - arm, y - arm);
  context.lineTo(x + arm, y + arm);
  context.moveTo(x - arm, y + arm);
  context.lineTo(x + arm, y - arm);
}

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

// Unit normals of a polyline at its corners, in the view.
function normals(places) {
  return places.map((_, index) => {
    const [x0, y0] = places[Math.max(index - 1, 0)];
    const [x1, y1] = places[Math.min(index + 1, places.length - 1)];
    const length = Math.hypot(x1 - x0, y1 - y0) || 1;
    return [(y0 - y1) / length, (x1 - x0) / length];
  });
}

function bandEdges(places, shape, zoom) {
  const across = normals(places);
  const side = (sign) =>
    places.map(([x, y], index) => {
      const half = sign * each(shape.halfWidth, index) * zoom;
      return [x + across[index][0] * half, y + across[index][1] * half];
    });
  return [side(1), side(-1)];
}

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
    for (const [radius, colour] of [[4.5, CASING], [3, look.colour]]) {
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
  text(context, places, shape) {
    places.forEach((place) => paintText(context, String(shape.label), place));
  },
  ticks(context, places, shape, look) {
    const across = normals(places);
    context.beginPath();
    places.forEach(([x, y], index) => {
      const [nx, ny] = across[index];
      context.moveTo(x - nx * 7, y - ny * 7);
      context.lineTo(x + nx * 7, y + ny * 7);
    });
    strokeCased(context, { ...look, dash: undefined });
    if (!Array.isArray(shape.label)) return;
    places.forEach(([x, y], index) => {
      const label = shape.label[index];
      if (label) paintText(context, String(label), [x + across[index][0] * 18, y + across[index][1] * 18], "center");
    });
  },
};

// The error in a shape as text; null if it can be painted.
export function shapeFault(shape) {
  if (!shape || !PAINTERS[shape.shape]) return `unknown shape ${JSON.stringify(shape && shape.shape)}`;
  if (!STYLES[shape.style]) return `unknown style ${JSON.stringify(shape.style)}`;
  const finite = (pair) => Array.isArray(pair) && pair.length === 2 && pair.every(Number.isFinite);
  if (!Array.isArray(shape.points) || !shape.points.every(finite)) return `${shape.shape} with points that are not numbers`;
  if (shape.shape === "band" && !given(shape.halfWidth)) return "band without halfWidth";
  return null;
}

export function paintShape(context, shape, toView, zoom, staleImage) {
  const look = STYLES[shape.style];
  if (shape.points.length === 0 || (staleImage && look.plan)) return;
  const places = shape.points.map(toView);
  context.lineJoin = "round";
  context.lineCap = "round";
  PAINTERS[shape.shape](context, places, shape, look, zoom);
  if (typeof shape.label === "string" && shape.shape !== "text") {
    const [x, y] = places[places.length - 1];
    paintText(context, shape.label, [x + 12, y - 12]);
  }
}

// Distance in CSS pixels from `at` to the shape, for the tooltip.
export function shapeDistance(shape, toView, zoom, at) {
  const places = shape.points.map(toView);
  const distances = places.map(([x, y], index) => {
    const away = Math.hypot(x - at[0], y - at[1]);
    return given(shape.radius) ? Math.max(away - each(shape.radius, index) * zoom, 0) : away;
  });
  if (["line", "polygon", "band", "ticks"].includes(shape.shape)) {
    for (let index = 1; index < places.length; index++) {
      distances.push(distanceToSegment(at, places[index - 1], places[index]));
    }
  }
  return Math.min(...distances, Infinity);
}

function distanceToSegment([x, y], [x0, y0], [x1, y1]) {
  const [dx, dy] = [x1 - x0, y1 - y0];
  const along = ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy || 1);
  const t = Math.min(Math.max(along, 0), 1);
  return Math.hypot(x - x0 - t * dx, y - y0 - t * dy);
}

// A pick: an open cross-hair in a ring, so that its pixel stays visible; a diamond if it is snapped to a curve.
export function paintPoint(context, point, [x, y], selected) {
  const look = STYLES[point.style];
  const radius = selected ? POINT_RADIUS + 2 : POINT_RADIUS;
  context.beginPath();
  if (point.snapped) {
    const reach = radius * 1.25;
    path(context, [[x, y - reach], [x + reach, y], [x, y + reach], [x - reach, y]], true);
  } else {
    context.arc(x, y, radius, 0, 2 * Math.PI);
  }
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + dx * 4, y + dy * 4);
    context.lineTo(x + dx * (radius + 5), y + dy * (radius + 5));
  }
  strokeCased(context, { ...look, width: selected ? 2.5 : 2, dash: point.movable ? undefined : [3, 3] });
  context.fillStyle = look.colour;
  context.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
}

// Names of points at `places`, within a view of this size: right of the point if there is space, else left, above or
// below. Aids are many and close together, so their names show only when selected.
export function paintNames(context, points, places, selected, size) {
  context.font = FONT;
  const r = POINT_RADIUS;
  const taken = places.map(([x, y]) => ({ left: x - r, right: x + r, top: y - r, bottom: y + r }));
  points.forEach((point, index) => {
    if (!point.label || (STYLES[point.style].silent && point.id !== selected)) return;
    const others = taken.filter((_, other) => other !== index);
    const boxes = roomAbout(places[index], context.measureText(point.label).width, size[0]);
    const box = boxes.find((one) => isWithin(one, size) && !others.some((other) => overlap(one, other)));
    const shown = box || boxes.find((one) => isWithin(one, size)) || boxes[0];
    taken.push(shown);
    paintText(context, point.label, [shown.left, (shown.top + shown.bottom) / 2]);
  });
}

function roomAbout([x, y], width, most) {
  const away = POINT_RADIUS + 9;
  const sides = [x + away, x - away - width];
  const middles = [-1, 1].flatMap((down) => sides.map((left) => [left, y + down * (POINT_RADIUS + 3)]));
  const centred = Math.min(Math.max(x - width / 2, 3), most - width - 3);
  middles.push(...[-1, 1].map((down) => [centred, y + down * 2.4 * POINT_RADIUS]));
  return middles.map(([left, middle]) => ({ left, right: left + width, top: middle - 9, bottom: middle + 9 }));
}

const isWithin = (box, [width, height]) => box.left > 2 && box.top > 2 && box.right < width - 2 && box.bottom < height - 2;
const overlap = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;

/** @type {(context: CanvasRenderingContext2D, at: number[], radius: number) => void} */
export function paintCrosshair(context, [x, y], radius) {
  context.beginPath();
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + dx * 6, y + dy * 6);
    context.lineTo(x + dx * radius, y + dy * radius);
  }
  strokeCased(context, { colour: COLOURS.yellow, width: 1 });
}
