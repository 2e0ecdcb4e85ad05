// Converts key events on the view to calls of the core. Escape, which ends a gesture, is with the gestures.

const PAN_KEY = 40; // CSS pixels
const STEP = 1; // image pixels an arrow key moves a point
const FINE_STEP = 0.1; // with shift

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Point} Point */
/** @typedef {import("./xray.js").XrayCore} XrayCore */

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
