// Loads the images of a view; the newest request wins.

/** @typedef {import("./types").Picture} Picture */
/** @typedef {import("./types").Image} Image */
/** @typedef {import("./types").Window} Window_ */

export class Stream {
  /** `onImage(image | null)` gets each image that was loaded; `onFault(message)` hears of one that cannot be.
   * @param {(image: Image | null) => void} onImage
   * @param {(message: string) => void} onFault */
  constructor(onImage, onFault) {
    this.onImage = onImage;
    this.onFault = onFault;
    /** @type {AbortController | null} */
    this.loading = null;
    /** @type {Picture | null} */
    this.asked = null; // the picture requested last; its pixels may not have arrived
  }

  /** Address of the picture requested last; null: none. */
  get url() {
    return this.asked?.url ?? null;
  }

  /** Whether this is another request than the last one.
   * @param {Picture | null} picture */
  isNew(picture) {
    return JSON.stringify(picture) !== JSON.stringify(this.asked);
  }

  /** Loads a picture: raw little-endian uint16, `width * height` of them, from its address.
   * @param {Picture | null} picture */
  async load(picture) {
    this.end();
    this.asked = picture;
    if (picture === null) {
      this.onImage(null);
      return;
    }
    const loading = (this.loading = new AbortController());
    try {
      const pixels = await fetchPixels(picture.url, picture.width, picture.height, loading.signal);
      if (this.loading === loading) this.loading = null;
      this.onImage({ ...picture, pixels });
    } catch (error) {
      if (loading.signal.aborted) return;
      this.loading = null;
      this.onImage(null); // an old image under a new plan would mislead
      this.onFault(error instanceof Error ? error.message : String(error));
    }
  }

  end() {
    if (this.loading) this.loading.abort();
    this.loading = null;
  }
}

// The pixels of an image, and its bitmap through a grey-level window.
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

export class Bitmap {
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

// Whether the image on the screen is current: a live image expires unless its time is extended.
//
// Times are by performance.now(). The browser itself notices that nothing was received; no message is needed for it.
export class Age {
  /** `onChange(stale)` hears when the image on the screen goes out of date, and when it is current again.
   * @param {(stale: boolean) => void} onChange */
  constructor(onChange) {
    this.onChange = onChange;
    this.stale = false;
    this.until = Infinity; // time until which the image on the screen is current
    /** @type {{ url: string | null, until: number } | null} */
    this.coming = null; // of an image that is not yet on the screen
    /** @type {number | undefined} */
    this.timer = undefined;
  }

  /** The image at `url` is current for `ms`, null: for ever. `shown`: address of the one on the screen.
   * @param {string | null} url
   * @param {number | null} ms
   * @param {string | null} shown */
  extend(url, ms, shown) {
    const until = ms === null ? Infinity : performance.now() + ms;
    this.coming = shown === url ? null : { url, until };
    this.until = shown === url ? until : Math.min(this.until, until); // the screen still shows an older one
    this.#look();
  }

  /** The image at `url` is on the screen.
   * @param {string | null} url */
  arrived(url) {
    if (!this.coming || this.coming.url !== url) return;
    this.until = this.coming.until;
    this.coming = null;
    this.#look();
  }

  // Nothing is extended any more: what can expire has expired.
  loseTouch() {
    if (this.until !== Infinity) this.until = 0;
    if (this.coming && this.coming.until !== Infinity) this.coming.until = 0;
    this.#look();
  }

  end() {
    clearTimeout(this.timer);
  }

  #look() {
    clearTimeout(this.timer);
    const left = this.until - performance.now();
    const stale = left <= 0;
    if (stale !== this.stale) this.onChange((this.stale = stale));
    if (!stale && left !== Infinity) this.timer = setTimeout(() => this.#look(), left);
  }
}
