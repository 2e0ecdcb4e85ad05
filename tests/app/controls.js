// The control that has the focus: where it is in the page, its name, and whether it shows that it has it; null where none
// has it. With an argument: all controls that a person could use, by the same marks.
(all) => {
  const shown = { opacityProperty: true, visibilityProperty: true };
  const mark = (element) => {
    const path = [];
    for (let at = element; at !== document.body; at = at.parentElement) path.unshift([...at.parentElement.children].indexOf(at));
    return path.join(".");
  };
  const name = (element) => {
    const labelled = (element.getAttribute("aria-labelledby") || "").split(" ").map((id) => document.getElementById(id)?.textContent);
    const label = element.labels && [...element.labels].map((one) => one.textContent).join(" ");
    return [element.getAttribute("aria-label"), ...labelled, label, element.innerText].map((one) => (one || "").trim()).find(Boolean) || "";
  };
  const ringed = (element) => {
    const style = getComputedStyle(element, element.matches(".xray-stage") ? "::after" : null);
    return parseFloat(style.outlineWidth) >= 2 && style.outlineStyle !== "none" || parseFloat(style.borderTopWidth) >= 2;
  };
  const told = (element) => ({ mark: mark(element), name: name(element), what: element.outerHTML.slice(0, 160),
    seen: ringed(element) || Boolean(element.closest(".q-field") && ringed(element.closest(".q-field").querySelector(".q-field__control"))) });
  if (!all) return document.activeElement === document.body ? null : told(document.activeElement);
  const usable = "button, input, select, textarea, summary, [tabindex], [role=checkbox], [role=radio]";
  const out = [...document.querySelectorAll(usable)].filter((one) => one.checkVisibility(shown) && !one.disabled);
  return out.filter((one) => one.getAttribute("tabindex") !== "-1" && one.getAttribute("aria-disabled") !== "true").map(told);
}
