// What is wrong with the place of things on the page: text that is cut, controls that overlap, parts off the screen, a
// column that scrolls. `scrolls`: whether the middle of the column may.
(scrolls) => {
  const shown = { opacityProperty: true, visibilityProperty: true };
  const seen = (element) => element.checkVisibility(shown) && element.getClientRects().length > 0;
  const what = (element) => `${element.tagName}.${element.className} ${element.textContent.trim().slice(0, 40)}`;
  const out = [];
  const all = (selector) => [...document.querySelectorAll(selector)].filter(seen);
  const box = document.querySelector(".step-box");
  if (!scrolls && box.scrollHeight > box.clientHeight + 1) out.push(`the column scrolls: ${box.scrollHeight} in ${box.clientHeight}`);
  for (const part of all("[data-testid=stop], .say, .steps .step, .time, .undo button, .lead button, .feet button, .verdict")) {
    const { left, top, right, bottom } = part.getBoundingClientRect();
    if (left < 0 || top < 0 || right > innerWidth + 0.5 || bottom > innerHeight + 0.5) out.push(`off the screen: ${what(part)}`);
    const at = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
    if (!part.contains(at)) out.push(`covered: ${what(part)} by ${at && what(at)}`);
  }
  const page = document.documentElement;
  if (page.scrollWidth > innerWidth || page.scrollHeight > innerHeight) out.push(`the page scrolls: ${page.scrollWidth}x${page.scrollHeight}`);
  for (const tools of all(".xray-tools")) {
    const rows = new Set([...tools.querySelectorAll("button")].filter(seen).map((one) => one.offsetTop));
    if (rows.size > 1) out.push(`tools in ${rows.size} rows`);
  }
  const letters = all(".depth-bar b").map((part) => {
    const text = document.createRange();
    text.selectNodeContents(part);
    return [part.textContent, text.getBoundingClientRect()];
  });
  const bar = all(".depth-bar")[0]?.getBoundingClientRect();
  letters.forEach(([name, a], k) => {
    if (a.right > bar.right) out.push(`a letter of the depth bar is cut: ${name}`);
    for (const [other, b] of letters.slice(k + 1))
      if (Math.min(a.right, b.right) - Math.max(a.left, b.left) > 0.5 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 0.5)
        out.push(`letters of the depth bar overlap: ${name} ${other}`);
  });
  for (const field of all(".kind .q-field__control")) { // its lower edge is a line
    const text = field.querySelector(".q-field__native span").getBoundingClientRect();
    if (text.bottom > field.getBoundingClientRect().bottom - 3) out.push(`on its line: ${what(field)}`);
  }
  const hint = all("[data-testid=hint]")[0]?.getBoundingClientRect();
  const name = all("[data-testid=hint]")[0]?.parentElement.querySelector(".xray-name").getBoundingClientRect();
  if (hint && hint.top > name.bottom) out.push("the hint is below the image's name"); // over the image and its labels
  const row = all(".drop-row")[0]?.getBoundingClientRect();
  for (const card of all(".verdict")) {
    const { top, bottom } = card.getBoundingClientRect();
    if (row && top < row.bottom + 3 && bottom > row.top) out.push(`touches: the card and the upload buttons, ${top - row.bottom}`);
  }
  const cut = ".say, .step, .time, .stop-box, .verdict, .figure, .pick-place, .feet button, .lead button, .group, .depth-value, .depth-marks div, .on-images button, .xray-hint, .xray-name, .xray-tools button, .xray-foot .xray-panel, .say > *";
  for (const part of all(cut)) {
    if (part.scrollWidth > part.clientWidth + 1 || part.scrollHeight > part.clientHeight + 1)
      out.push(`cut: ${what(part)} ${part.scrollWidth}x${part.scrollHeight} in ${part.clientWidth}x${part.clientHeight}`);
  }
  const parts = all(".top .action, .time, .say, .panel .action, .figure, .verdict, .kind");
  const inside = (part) => part.getBoundingClientRect().bottom <= box.getBoundingClientRect().bottom || !box.contains(part);
  const boxes = parts.filter(inside).map((part) => [part, part.getBoundingClientRect()]);
  boxes.forEach(([one, a], k) => {
    for (const [other, b] of boxes.slice(k + 1)) {
      const [x, y] = [Math.min(a.right, b.right) - Math.max(a.left, b.left), Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top)];
      if (x > 1 && y > 1 && !one.contains(other) && !other.contains(one)) out.push(`overlap: ${what(one)} / ${what(other)}`);
    }
  });
  return out;
}
