// On paper nothing is folded.
let folded = [];
addEventListener("beforeprint", () => { folded = [...document.querySelectorAll("details:not([open])")]; folded.forEach((one) => { one.open = true; }); });
addEventListener("afterprint", () => folded.forEach((one) => { one.open = false; }));

// Rotates the drawing of the set-up by dragging or with the arrow keys. Same projection as report/scene.py.
for (const picture of document.querySelectorAll("svg.space")) {
  let [azimuth, elevation, scale] = picture.dataset.view.split(",").map(Number);
  const parts = [...picture.querySelectorAll("[data-xyz]")].map((node) => ({
    node,
    xyz: node.dataset.xyz.split(";").map((p) => p.split(",").map(Number)),
  }));
  const all = parts.flatMap((p) => p.xyz);
  const middle = [0, 1, 2].map((k) => {
    const values = all.map((p) => p[k]);
    return (Math.min(...values) + Math.max(...values)) / 2;
  });
  const box = picture.viewBox.baseVal;
  const draw = () => {
    const a = (azimuth * Math.PI) / 180, e = (elevation * Math.PI) / 180;
    const page = (p) => {
      const [x, y, z] = p.map((v, k) => v - middle[k]);
      const depth = x * Math.sin(a) + y * Math.cos(a);
      return [
        box.width / 2 + scale * (x * Math.cos(a) - y * Math.sin(a)),
        box.height / 2 - scale * (z * Math.cos(e) + depth * Math.sin(e)),
      ];
    };
    for (const { node, xyz } of parts) {
      const at = xyz.map(page);
      if (node.tagName === "text") { node.setAttribute("x", at[0][0]); node.setAttribute("y", at[0][1]); }
      else if (node.tagName === "circle") { node.setAttribute("cx", at[0][0]); node.setAttribute("cy", at[0][1]); }
      else node.setAttribute("points", at.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" "));
    }
  };
  const turn = (dx, dy) => {
    azimuth -= dx;
    elevation = Math.max(-90, Math.min(90, elevation + dy));
    draw();
  };
  picture.addEventListener("pointerdown", (event) => { picture.setPointerCapture(event.pointerId); event.preventDefault(); picture.focus(); });
  picture.addEventListener("pointermove", (event) => { if (event.buttons) turn(-event.movementX * 0.4, event.movementY * 0.4); });
  picture.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [5, 0], ArrowRight: [-5, 0], ArrowUp: [0, -5], ArrowDown: [0, 5] }[event.key];
    if (step) { turn(...step); event.preventDefault(); }
  });
}
