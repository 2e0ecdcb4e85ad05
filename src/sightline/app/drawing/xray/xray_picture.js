// The pixels of an image, and its bitmap through a grey-level window.

/** @typedef {import("./types").Window} Window_ */

const GREY_LEVELS = 65536;
const CRISP_ZOOM = 3; // device pixels per image pixel from which pixels are drawn as squares, without interpolation

/** Raw little-endian uint16 from `url`, by rows. Throws unless there are `width * height` of them.
 * @param {string} url
 * @param {number} width
 * @param {number} height
 * @param {AbortSignal} signal */
export async function fetchPixels(url, width, height, signal) {
  const answer = await fetch(url, { signal });
  if (!answer.ok) throw new Error(`image: HTTP ${answer.status}`);
  const bytes = await answer.arrayBuffer();
  if (bytes.byteLength !== 2 * width * height) {
    throw new Error(`image: ${bytes.byteLength} bytes, not ${width} x ${height} of two`);
  }
  return new Uint16Array(bytes);
}

/** A valid window: at least two grey levels, at most all.
 * @param {Window_} window
 * @returns {Window_} */
export function heldWindow({ centre, width }) {
  /** @type {(value: number, low: number) => number} */
  const held = (value, low) => Math.min(Math.max(value, low), GREY_LEVELS);
  return { centre: held(centre, 0), width: held(width, 2) };
}

export class Picture {
  constructor() {
    this.bitmap = document.createElement("canvas"); // one bitmap pixel per image pixel
    this.context = /** @type {CanvasRenderingContext2D} */ (this.bitmap.getContext("2d", { alpha: false }));
    /** @type {ImageData | null} */
    this.shown = null;
  }

  /** grey = (value - centre) / width + 1/2, clipped to black and white, by a look-up table.
   * @param {import("./types").Image} image
   * @param {Window_} window
   * @param {boolean} inverted */
  draw({ width, height, pixels }, window, inverted) {
    if (!this.shown || this.shown.width !== width || this.shown.height !== height) {
      Object.assign(this.bitmap, { width, height });
      this.shown = new ImageData(width, height);
    }
    const table = greyTable(window, inverted);
    const out = new Uint32Array(this.shown.data.buffer);
    for (let index = 0; index < out.length; index++) out[index] = table[pixels[index]];
    this.context.putImageData(this.shown, 0, 0);
  }

  /** Draws the bitmap with `uv` at `at` (CSS pixels), by the linear part [a, b, c, d] of a display.
   * @param {CanvasRenderingContext2D} context
   * @param {number[]} linear
   * @param {number[]} uv
   * @param {number[]} at
   * @param {number[]} density device pixels per CSS pixel, across and down */
  paint(context, [a, b, c, d], uv, at, [sx, sy]) {
    context.setTransform(a * sx, b * sy, c * sx, d * sy, at[0] * sx, at[1] * sy);
    context.imageSmoothingEnabled = Math.hypot(a, b) * sx < CRISP_ZOOM;
    context.imageSmoothingQuality = "medium";
    context.drawImage(this.bitmap, -0.5 - uv[0], -0.5 - uv[1]); // pixel (0, 0) is centred on (0, 0)
  }
}

/** @param {Window_} window
 * @param {boolean} inverted */
function greyTable({ centre, width }, inverted) {
  const table = new Uint32Array(GREY_LEVELS);
  for (let value = 0; value < GREY_LEVELS; value++) {
    const grey = Math.min(Math.max((value - centre) / width + 0.5, 0), 1);
    const level = Math.round(255 * (inverted ? 1 - grey : grey));
    table[value] = 0xff000000 | (level << 16) | (level << 8) | level;
  }
  return table;
}
