// What a person reads on the page: every word that is shown, its colour and size, and the grounds below it, the nearest
// first, down to one that lets nothing through, or to an image, which may be black or white.
() => {
  const skipped = "script, style, [disabled], [aria-disabled=true], .unseen, .xray-live, .q-focus-helper";
  const shown = { opacityProperty: true, visibilityProperty: true };
  const over = (element) => {
    const grounds = [];
    let opacity = 1;
    for (let at = element; at; at = at.parentElement) {
      const style = getComputedStyle(at);
      if (at.matches(".xray, .space")) return { grounds: [...grounds, "image"], opacity };
      opacity *= Number(style.opacity);
      if (style.backgroundColor !== "rgba(0, 0, 0, 0)") grounds.push(style.backgroundColor);
      if (/^rgb\(/.test(style.backgroundColor)) break;
    }
    return { grounds, opacity };
  };
  const words = [];
  const look = (element, text) => {
    if (!text.trim() || element.closest(skipped) || !element.checkVisibility(shown)) return;
    const style = getComputedStyle(element);
    const colour = element instanceof SVGElement ? style.fill : style.color;
    const size = parseFloat(style.fontSize) * (element.ownerSVGElement ? element.getScreenCTM().a : 1);
    words.push({ text: text.trim(), colour, size, bold: Number(style.fontWeight) >= 700, ...over(element) });
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) look(walker.currentNode.parentElement, walker.currentNode.textContent);
  for (const field of document.querySelectorAll("input")) look(field, field.value);
  return words;
}
