// HTML that comes as a message: only this element is updated. (A changed property makes Vue visit every element of the
// page.)

export default {
  template: "<section></section>",
  methods: {
    /** @this {{ $el: HTMLElement }} @param {string} html */
    show(html) {
      const wanted = document.createElement("template");
      wanted.innerHTML = html;
      patch(this.$el, wanted.content);
    },
  },
};

/** Makes the children of `shown` those of `wanted`. Elements that both have stay, with their texts and attributes set
 * where they differ: in a drag few do, and to lay out new elements takes longer than all else in a message.
 * @type {(shown: ParentNode, wanted: ParentNode) => void} */
function patch(shown, wanted) {
  const [before, after] = [shown, wanted].map(({ childNodes }) => [...childNodes]);
  if (before.length !== after.length || before.some(({ nodeName }, k) => nodeName !== after[k].nodeName)) {
    shown.replaceChildren(...after);
    return;
  }
  before.forEach((old, k) => {
    const now = after[k];
    if (old instanceof Element && now instanceof Element) patchElement(old, now);
    else if (old.nodeValue !== now.nodeValue) old.nodeValue = now.nodeValue;
  });
}

/** @type {(shown: Element, wanted: Element) => void} */
function patchElement(shown, wanted) {
  for (const name of shown.getAttributeNames()) if (!wanted.hasAttribute(name)) shown.removeAttribute(name);
  for (const { name, value } of wanted.attributes) {
    if (shown.getAttribute(name) !== value) shown.setAttribute(name, value);
  }
  patch(shown, wanted);
}
