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
