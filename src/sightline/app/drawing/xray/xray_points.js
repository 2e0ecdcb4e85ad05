// A button for each placed point, for the tab key and screen readers.

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Placed} Placed */

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
