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
