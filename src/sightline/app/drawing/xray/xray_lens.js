// The round magnifier above the pointer (below it at the upper edge), with a cross-hair at its position.

import { COLOURS } from "colours";
import { paintCrosshair } from "./xray_paint.js";

/** @typedef {import("./types").Pair} Pair */

const TIMES = 4;
const ZOOM_MAX = 32; // [ours] CSS pixels per image pixel: enough to point at 1/32 of a pixel
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
