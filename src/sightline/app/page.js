// The space bar stops the robot wherever the focus is, except in a text field; it presses no other control.
/**
 * The element that an event happened to; null for the window or the document.
 * @param {Event} event
 */
const elementOf = (event) => (event.target instanceof Element ? event.target : null);
/** @param {Event} event */
const typing = (event) => elementOf(event)?.closest("input:not([readonly]), textarea, select, [contenteditable=true]");
for (const kind of /** @type {const} */ (["keydown", "keyup"])) {
  window.addEventListener(
    kind,
    (event) => {
      /** @type {HTMLButtonElement | null} */
      const stop = document.querySelector("[data-testid=stop]");
      if (event.key !== " " || !stop || stop.disabled || typing(event)) return; // disabled without a robot
      event.preventDefault();
      event.stopPropagation();
      if (kind === "keydown" && !event.repeat) stop.click();
    },
    true,
  );
}

// Arrow keys move between the radios of a group, and choose.
/** @type {Record<string, number | undefined>} */
const STEP = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };
window.addEventListener("keydown", (event) => {
  /** @type {HTMLElement | null | undefined} */
  const radio = elementOf(event)?.closest("[role=radio]");
  const group = radio?.closest("[role=radiogroup]");
  const by = STEP[event.key];
  if (!radio || !group || !by) return;
  event.preventDefault();
  const all = /** @type {HTMLElement[]} */ ([...group.querySelectorAll("[role=radio]")]);
  const next = all[(all.indexOf(radio) + by + all.length) % all.length];
  next.focus();
  next.click();
});

// A button that was built again between press and release, at another place of the page's tree, gets the click that the
// browser gives to neither. Its name and words must be the same.
/** @type {HTMLElement | null} */
let pressed = null;
window.addEventListener(
  "pointerdown",
  (event) => (pressed = (event.button === 0 && elementOf(event)?.closest("button[data-testid]")) || null),
  true,
);
window.addEventListener(
  "pointerup",
  ({ clientX, clientY }) => {
    const before = pressed;
    pressed = null;
    if (!before || before.isConnected) return;
    /** @type {HTMLElement | null | undefined} */
    const again = document.elementFromPoint(clientX, clientY)?.closest("button[data-testid]");
    if (!again || again.dataset.testid !== before.dataset.testid) return;
    if (again.textContent === before.textContent) again.click(); // of one that is disabled nothing comes
  },
  true,
);

// A control that was built again keeps the focus. Of a list that is chosen from its box has it: in a field, keys such as
// those of undo would be taken for text.
/** @type {HTMLElement | null} */
let focused = null; // the named control that has it
window.addEventListener("focusin", (event) => (focused = elementOf(event)?.closest("[data-testid]") ?? null));
const keepFocus = () => {
  if (!focused || focused.isConnected || document.activeElement !== document.body) return;
  /** @type {HTMLElement | null} */
  const again = document.querySelector(`[data-testid="${focused.dataset.testid}"]`);
  focused = null;
  if (!again) return;
  const field = "input:not([readonly]), button";
  /** @type {HTMLElement | null} */
  const inner = again.querySelector(field);
  const within = again.matches(field) ? again : inner || again;
  if (within.tabIndex < 0) within.tabIndex = -1; // so that a box can have it
  within.focus({ preventScroll: true });
};

// Until the handshake NiceGUI keeps each event on a timer of its own, so that they are sent in any order: Enter before
// the text of its field. Socket.IO keeps their order, and sends them after the handshake, which is part of connecting.
Object.defineProperty(window, "did_handshake", { get: () => true, set: () => {} });

// The page probes the program five times a second. Without an answer the page may be out of date and STOP does not
// reach the robot: body.dead shows that (page.css). Nothing is shown before the first connection, while the page is built.
const ASK_MS = 200; // [ours]
const DEAD_MS = 600; // [ours] without an answer; detection takes less than a second in all
/** @type {number | null} */
let asked = null; // time of an unanswered probe
let looked = performance.now();
let known = false;
setInterval(() => {
  const now = performance.now();
  if (now - looked > 2 * ASK_MS) asked = null; // the page itself was suspended
  looked = now;
  const { socket } = window;
  if (!socket || !(known ||= socket.connected)) return;
  if (!socket.connected) asked = null;
  else if (asked === null) {
    const mine = (asked = now);
    socket.emit("alive", () => {
      if (asked === mine) asked = null;
    });
  }
  document.body.classList.toggle("dead", !socket.connected || (asked !== null && now - asked > DEAD_MS));
}, ASK_MS);

// Each step is an entry of the browser's history: Back goes to the step before, a reload keeps the step. An entry
// before the first is never shown: going back to it opens the question whether to leave.
//
// The entry is made when the page shows the step, not by a message of its own: a reload between both would lose it.
const LEAVE = "leave";
let went = 0; // how often Back and Forward went to another step; the page shows how many of them the program followed
/** @type {string | null} */
let shown = null; // the step that the page shows; null until it is built
const followed = () => Number(document.querySelector("nav")?.dataset.went) === went;
/** @param {string} step */
const goTo = (step) => emitEvent("step", step, ++went);
const followStep = () => {
  /** @type {HTMLElement | null} */
  const button = document.querySelector(".step[aria-current=step]");
  const step = button?.dataset.testid?.replace("step-", "");
  if (!step) return;
  const at = history.state?.sightline;
  const isFirst = shown === null;
  shown = step;
  if (at === step || !followed()) return;
  if (isFirst && at && at !== LEAVE) return goTo(at); // Back while the page was being built
  if (!at) history.replaceState({ sightline: LEAVE }, "");
  history.pushState({ sightline: step }, "", `?step=${encodeURIComponent(step)}`);
};
// Another case is open: the page shows it on the step that it has reached.
window.sightlineOpened = () => location.replace("/");
window.sightlineLeave = () => history.go(-2);
window.addEventListener("popstate", ({ state }) => {
  const to = state?.sightline;
  if (to === LEAVE) {
    history.forward();
    emitEvent("leave");
  } else if (to && shown !== null && (to !== shown || !followed())) goTo(to);
});

// An enlarged image leaves the bar with STOP visible.
window.addEventListener("DOMContentLoaded", () => {
  const measure = () => {
    const work = document.querySelector(".work");
    /** @type {HTMLElement | null} */
    const panel = document.querySelector(".panel");
    if (work) document.body.style.setProperty("--xray-top", `${work.getBoundingClientRect().top}px`);
    if (panel) document.body.style.setProperty("--xray-right", `${panel.offsetWidth}px`);
  };
  new ResizeObserver(measure).observe(document.body);
  const changed = new MutationObserver(() => {
    for (const tip of document.querySelectorAll("body > [id^=q-portal--tooltip]")) tip.ariaLive = "polite"; // it is read aloud
    measure();
    keepFocus();
    followStep();
  });
  changed.observe(document.body, { childList: true, subtree: true, attributeFilter: ["aria-current", "data-went"] });
});
