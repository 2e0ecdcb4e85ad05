// Elements around the image: the view's box, its buttons and its style sheet.
//
// Texts come from outside and are inserted as text nodes, never as HTML.

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Window} Window_ */

const SVG = "http://www.w3.org/2000/svg";
/** @type {Record<string, string>} */
const ICONS = {
  fit: "M4 9V4h5M20 9V4h-5M4 15v5h5M20 15v5h-5M9 9h6v6H9z",
  link: "M10 14a4 4 0 0 1 0-5.6l2.5-2.5a4 4 0 0 1 5.6 5.6L16.5 13M14 10a4 4 0 0 1 0 5.6l-2.5 2.5a4 4 0 0 1-5.6-5.6L7.5 11",
  measure: "M3 16L16 3l5 5L8 21zM7 12l2.5 2.5M10 9l1.5 1.5M13 6l2.5 2.5",
  window: "M12 3v2M12 19v2M3 12h2M19 12h2M5.6 5.6l1.4 1.4M17 17l1.4 1.4M18.4 5.6L17 7M7 17l-1.4 1.4M12 8a4 4 0 0 0 0 8zM12 8a4 4 0 0 1 0 8",
  invert: "M12 3a9 9 0 1 0 0 18a9 9 0 0 0 0-18M12 3v18M12 7.5h4.8M12 12h9M12 16.5h4.8",
  flip: "M12 3v18M9 7L4 17h5zM15 7l5 10h-5z",
  rotate: "M20 5v5h-5M19.6 10A8 8 0 1 0 20 14",
  reset: "M4 5v5h5M4.4 10A8 8 0 1 1 4 14M12 9v4l3 2",
  maximise: "M14 4h6v6M20 4l-7 7M10 20H4v-6M4 20l7-7",
  restore: "M20 10h-6V4M14 10l7-7M4 14h6v6M10 14l-7 7",
};

// `contain: strict`: a text that changes in a view is laid out there, not with the whole page; the view's size comes from
// outside. Controls are 2.75 em, more than the 24 CSS pixels of WCAG 2.2 (2.5.8).
const SHEET = `
.xray { position: relative; width: 100%; height: 100%; min-height: 12em; overflow: hidden; contain: strict; container-type: inline-size;
  background: var(--stage); color: var(--text);
  font: 400 clamp(15px, 11px + 0.32vw, 24px)/1.35 Roboto, system-ui, "Segoe UI", "DejaVu Sans", sans-serif;
  border: 1px solid var(--line); border-radius: 0.5em; user-select: none; -webkit-user-select: none; }
.xray.xray-maximised { position: fixed; inset: var(--xray-top, 0) 0 0 0; z-index: 2500; border-radius: 0; height: auto; width: auto; }
.xray-stage { position: absolute; inset: 0; touch-action: none; outline: none; cursor: default; }
.xray-stage canvas { position: absolute; inset: 0; width: 100%; height: 100%; }
.xray-stage[data-cursor=grab] { cursor: grab; } .xray-stage[data-cursor=pan] { cursor: grabbing; }
.xray-stage[data-cursor=window] { cursor: ns-resize; } .xray-stage[data-cursor=none] { cursor: none; }
.xray-stage[data-cursor=place] { cursor: crosshair; } .xray-lens .xray-points { opacity: 0; }
.xray.xray.xray .xray-lens-top ~ .xray-head > :is(.xray-name, .xray-hint, .xray-tools) { opacity: 0; }
.xray-stage:focus-visible::after { content: ""; position: absolute; inset: 2px; border: 2px solid var(--sky); border-radius: 0.4em; pointer-events: none; }
.xray-points button { position: absolute; left: -1.4em; top: -1.4em; width: 2.8em; height: 2.8em; padding: 0; background: none; border: 0;
  border-radius: 50%; pointer-events: none; outline-offset: 2px; }
.xray-points button:focus { outline: 2px solid transparent; }
.xray-points button:focus-visible { outline: 3px solid var(--text); box-shadow: 0 0 0 3px var(--stage), 0 0 0 8px rgba(5, 8, 11, 0.6); }
.xray-panel { background: rgba(12, 16, 20, 0.84); border-radius: 0.45em; }
.xray-head { position: absolute; left: 0.6em; top: 0.6em; right: 0.6em; display: flex; flex-wrap: wrap; gap: 0.5em;
  align-items: flex-start; justify-content: space-between; pointer-events: none; }
.xray-name { padding: 0.42em 0.8em; font-weight: 650; white-space: nowrap; }
.xray-notices { flex-basis: 100%; display: flex; flex-direction: column; gap: 0.3em; align-items: flex-start; }
.xray-notice { padding: 0.42em 0.8em; color: var(--orange); border-left: 0.25em solid currentColor; }
.xray-head > .xray-hint { flex: 1; min-width: 0; align-self: stretch; padding-block: 0.1em; display: flex; align-items: center; font-size: 0.87em; line-height: 1.2; }
.xray-hint { color: var(--text); border-left-color: var(--sky); }
.xray-tools { display: flex; flex-wrap: wrap; gap: 0.15em; padding: 0.2em; pointer-events: auto; }
.xray-tools button { width: 2.75em; height: 2.75em; padding: 0; display: grid; place-items: center; color: var(--text); background: none; border: 0;
  border-radius: 0.35em; cursor: pointer; font: inherit; }
.xray-tools { opacity: 0; transition: opacity 0.15s; }
.xray:hover .xray-tools, .xray:has(:focus-visible) .xray-tools { opacity: 1; }
@media (hover: none) { .xray-tools { opacity: 1; } }
@media (prefers-reduced-motion: reduce) { .xray-tools { transition: none; } }
.xray-presets { display: flex; } .xray-tools .xray-presets button { width: auto; padding: 0 0.5em; }
.xray-tools button:hover { background: var(--raised); color: var(--text); }
.xray-tools button[aria-pressed=true] { background: var(--chosen); color: var(--text); box-shadow: inset 0 -0.16em var(--sky); }
.xray-tools button:focus-visible { outline: 3px solid var(--sky); outline-offset: -3px; }
.xray-tools svg { width: 1.5em; height: 1.5em; fill: none; stroke: currentColor; stroke-width: 1.8; stroke-linecap: round; stroke-linejoin: round; }
.xray-foot { position: absolute; left: 0.6em; right: 0.6em; bottom: 0.6em; display: flex; flex-direction: column; align-items: flex-start; gap: 0.3em; pointer-events: none; font-variant-numeric: tabular-nums; color: var(--text); font-size: 0.93em; }
.xray-row { display: flex; align-self: stretch; justify-content: space-between; align-items: flex-end; gap: 0.6em; }
.xray-foot .xray-panel { padding: 0.3em 0.7em; white-space: pre; overflow: hidden; text-overflow: ellipsis; }
.xray-identity { font-weight: 400; font-size: 0.87em; line-height: 1.15; } .xray-foot .xray-legend { white-space: normal; } .xray-turned { font-weight: 400; } .xray-turned.unusual { color: var(--orange); font-weight: 650; } .xray-turned:not(:empty) { margin-left: 0.7em; }
.xray-tip { position: absolute; left: 0; top: 0; max-width: 22em; padding: 0.4em 0.7em; pointer-events: none; white-space: pre-line; overflow-wrap: anywhere;
  background: rgba(12, 16, 20, 0.95); border: 1px solid var(--line); }
.xray-live { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); white-space: nowrap; }
.xray [hidden], .xray-empty :is(.xray-tools, .xray-foot) { display: none; }
@container (max-width: 38em) { /* one row of tools, in German too */
  .xray-tools { gap: 0; } .xray-tools button { width: 2em; height: 2.5em; } .xray-tools .xray-presets button { padding: 0 0.25em; } .xray-name { padding-inline: 0.55em; }
}
@container (max-width: 29em) {
  .xray-tools { margin-inline: -0.5em; padding-inline: 0; } .xray-tools button { width: 1.7em; } .xray-tools .xray-presets button { padding: 0 0.15em; font-size: 0.83em; height: auto; }
  .xray-row { flex-wrap: wrap; } /* no number is cut */
}
`;

/** @type {CSSStyleSheet | null} */
let sheet = null; // shared by all views of the page

function useSheet() {
  if (sheet) return;
  sheet = new CSSStyleSheet(); // constructed, because a content policy may forbid inline styles
  sheet.replaceSync(SHEET);
  document.adoptedStyleSheets = [...document.adoptedStyleSheets, sheet];
}

/** @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {string} className
 * @param {Record<string, string>} [attributes] */
function element(tag, className, attributes = {}) {
  const made = document.createElement(tag);
  made.className = className;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

/** @param {string} name */
function icon(name) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS(SVG, "path");
  path.setAttribute("d", ICONS[name]);
  svg.append(path);
  return svg;
}

export class Chrome {
  /** `actions` maps each button's name to its action.
   * @param {HTMLElement} root
   * @param {string} label
   * @param {import("./types").Texts} texts
   * @param {import("./xray_settings.js").Settings["actions"]} actions */
  constructor(root, label, texts, actions) {
    useSheet();
    this.texts = texts;
    this.root = root;
    root.classList.add("xray", "xray-empty");
    root.setAttribute("role", "group");
    this.stage = element("div", "xray-stage", { tabindex: "0", role: "application" });
    this.canvas = element("canvas", "xray-canvas", { "aria-hidden": "true" });
    this.points = element("div", "xray-points");
    this.stage.append(this.canvas, this.points);
    this.notice = this.#line("notice");
    this.stale = this.#line("stale");
    this.fault = this.#line("fault");
    this.lost = this.#line("lost");
    this.hint = this.#line("hint");
    this.measured = this.#line("measured");
    this.readout = element("div", "xray-panel", { "data-testid": "readout" });
    this.state = element("div", "xray-panel", { "data-testid": "state" });
    this.title = element("span", "");
    this.identity = element("div", "xray-identity", { "data-testid": "identity" });
    this.turned = element("span", "xray-turned", { "data-testid": "turned" });
    this.legend = element("div", "xray-panel xray-legend", { "data-testid": "legend", hidden: "" });
    this.tip = element("div", "xray-panel xray-tip", { role: "tooltip", "data-testid": "tip", hidden: "" });
    this.live = element("div", "xray-live", { "aria-live": "polite", "data-testid": "live" });
    /** @type {Record<string, HTMLButtonElement>} */
    this.buttons = {};
    this.name = element("div", "xray-panel xray-name");
    this.tools = element("div", "xray-panel xray-tools", { role: "toolbar" });
    this.presets = element("span", "xray-presets");
    this.choose = actions.preset;
    /** @type {Pair} */
    this.nameCorner = [0, 0]; // the lower right one of the image's name in the view, CSS pixels
    this.headBottom = 0; // the lower edge of the tools in the view, CSS pixels
    root.append(this.stage, this.#head(actions), this.#foot(), this.tip, this.live);
    this.setLabel(label);
  }

  /** The image's title.
   * @param {string} label */
  setLabel(label) {
    if (this.title.textContent === label) return;
    this.title.textContent = label;
    for (const named of [this.root, this.stage, this.tools]) named.setAttribute("aria-label", label);
  }

  /** Measure the image's name anew; not while painting, which would lay out the page for each image. */
  measureName() {
    const [all, own, tools] = [this.root, this.name, this.tools].map((one) => one.getBoundingClientRect());
    this.nameCorner = [own.right - all.left, own.bottom - all.top];
    this.headBottom = tools.bottom - all.top;
  }

  /** A line of text over the image, hidden while empty.
   * @param {string} name */
  #line(name) {
    const line = element("div", "xray-panel xray-notice", { role: "status", "data-testid": name, hidden: "" });
    line.classList.toggle("xray-hint", name === "hint" || name === "measured");
    return line;
  }

  /** @param {import("./xray_settings.js").Settings["actions"]} actions */
  #head({ preset, ...actions }) {
    const head = element("div", "xray-head");
    this.name.append(this.title, this.turned, this.identity);
    const notices = element("div", "xray-notices");
    notices.append(this.fault, this.lost, this.notice, this.stale, this.measured);
    for (const [action, act] of Object.entries(actions)) this.tools.append(this.#button(action, act));
    this.buttons.window.after(this.presets);
    head.append(this.name, this.hint, this.tools, notices); // the hint is beside the name, where it covers no label
    return head;
  }

  /** @type {(action: string, act: () => void) => HTMLButtonElement} */
  #button(action, act) {
    const button = element("button", "", { type: "button" });
    this.buttons[action] = button;
    this.relabel(action, action);
    button.addEventListener("click", act);
    return button;
  }

  #foot() {
    const foot = element("div", "xray-foot");
    const row = element("div", "xray-row");
    row.append(this.readout, this.state);
    foot.append(this.legend, row);
    return foot;
  }

  /** @param {string} action
   * @param {string} name */
  relabel(action, name) {
    const button = this.buttons[action];
    button.setAttribute("aria-label", this.texts[name]);
    button.title = this.texts[name];
    button.replaceChildren(icon(name));
  }

  /** A button for each preset, pressed where it is the window shown.
   * @param {Record<string, { centre: number, width: number }>} presets
   * @param {{ centre: number, width: number }} shown */
  showPresets(presets, shown) {
    const key = JSON.stringify(presets);
    if (this.presets.dataset.key !== key) {
      this.presets.dataset.key = key;
      this.presets.replaceChildren(...Object.entries(presets).map(([name, window]) => this.#preset(name, window)));
    }
    for (const button of this.presets.children) {
      const { centre, width } = presets[/** @type {HTMLElement} */ (button).dataset.preset ?? ""];
      button.setAttribute("aria-pressed", String(centre === shown.centre && width === shown.width));
    }
  }

  /** @type {(name: string, window: Window_) => HTMLButtonElement} */
  #preset(name, window) {
    const button = element("button", "", { type: "button", "data-preset": name });
    button.textContent = this.texts[name];
    button.addEventListener("click", () => this.choose(window));
    return button;
  }

  /** Height that the lines at the foot take from the image, em. */
  get footEm() {
    return this.legend.hidden ? 2.6 : 4.8;
  }

  /** @param {string} action
   * @param {boolean} on */
  press(action, on) {
    this.buttons[action].setAttribute("aria-pressed", String(on));
  }

  /** @param {string} text */
  say(text) {
    this.live.textContent = text;
  }

  /** @param {HTMLElement} line
   * @param {string | null} text */
  showLine(line, text) {
    line.hidden = !text;
    this.showText(line, text || "");
  }

  /** @param {string} numbers
   * @param {string} turned
   * @param {boolean} usual */
  showState(numbers, turned, usual) {
    this.showText(this.state, numbers);
    this.showText(this.turned, turned);
    this.turned.classList.toggle("unusual", !usual);
  }

  /** Set a text only if it differs: setting it causes a new layout.
   * @param {HTMLElement} where
   * @param {string} text */
  showText(where, text) {
    if (where.textContent !== text) where.textContent = text;
  }

  /** @param {string} text
   * @param {Pair} at */
  showTip(text, [x, y]) {
    this.tip.hidden = !text;
    if (!text) return;
    this.tip.textContent = text;
    const left = Math.min(x + 16, this.root.clientWidth - this.tip.offsetWidth - 8);
    const top = y + 20 + this.tip.offsetHeight > this.root.clientHeight ? y - this.tip.offsetHeight - 12 : y + 20;
    this.tip.style.transform = `translate(${Math.max(left, 8)}px, ${Math.max(top, 8)}px)`;
  }
}
