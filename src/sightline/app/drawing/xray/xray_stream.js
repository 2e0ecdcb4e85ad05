// Loads the images of a view; the newest request wins.

import { fetchPixels } from "./xray_picture.js";

/** @typedef {import("./types").Picture} Picture */
/** @typedef {import("./types").Image} Image */

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
