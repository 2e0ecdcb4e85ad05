// The space bar stops the robot wherever the focus is, but in a field where people type; it presses nothing else.
const typing = (target) => target.closest && target.closest("input, textarea, select, [contenteditable=true]");
for (const kind of ["keydown", "keyup"]) {
  window.addEventListener(
    kind,
    (event) => {
      const stop = document.querySelector("[data-testid=stop]");
      if (event.key !== " " || !stop || typing(event.target)) return;
      event.preventDefault();
      event.stopPropagation();
      if (kind === "keydown" && !event.repeat) stop.click();
    },
    true,
  );
}

// The page asks five times a second whether the program answers. Where it does not, what is shown may be of before, and
// STOP goes nowhere: body.dead says so (page.css). Nothing is said before the first connection, while the page is built.
const ASK_MS = 200; // [ours]
const DEAD_MS = 600; // [ours] without an answer; with what comes before and after it less than a second
let asked = null; // when, of a question that is not answered
let looked = performance.now();
let known = false;
setInterval(() => {
  const now = performance.now();
  if (now - looked > 2 * ASK_MS) asked = null; // it was the page that slept
  looked = now;
  const { socket } = window;
  if (!socket || !(known ||= socket.connected)) return;
  if (!socket.connected) asked = null;
  else if (asked === null) {
    const mine = (asked = now);
    socket.emit("alive", () => asked === mine && (asked = null));
  }
  document.body.classList.toggle("dead", !socket.connected || (asked !== null && now - asked > DEAD_MS));
}, ASK_MS);

// Each step is an entry of the browser's history: Back goes to the step before, a reload stays where it was. Before the
// first there is an entry that is never shown: who goes back to it is asked whether to leave.
const LEAVE = "leave";
// Word of a step comes late: a Back that overtook it counts. `before`: the step that was left, null where the page opens.
window.sightlineStep = (before, step) => {
  const at = history.state && history.state.sightline;
  if (at === step || (at && at !== before)) return;
  if (!at) history.replaceState({ sightline: LEAVE }, "");
  history.pushState({ sightline: step }, "", `?step=${encodeURIComponent(step)}`);
};
window.sightlineLeave = () => history.go(-2);
window.addEventListener("popstate", ({ state }) => {
  const to = state && state.sightline;
  if (to === LEAVE) {
    history.forward();
    emitEvent("leave");
  } else if (to) {
    const button = document.querySelector(`[data-testid="step-${to}"]`);
    if (button && button.getAttribute("aria-current") !== "step") button.click();
  }
});

// An enlarged image leaves the bar with STOP in sight.
window.addEventListener("DOMContentLoaded", () => {
  const measure = () => {
    const work = document.querySelector(".work");
    if (work) document.body.style.setProperty("--xray-top", `${work.getBoundingClientRect().top}px`);
  };
  new ResizeObserver(measure).observe(document.body);
  new MutationObserver(measure).observe(document.body, { childList: true, subtree: true });
});
