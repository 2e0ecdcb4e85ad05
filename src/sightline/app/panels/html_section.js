// HTML that comes as a message: only this element is updated. (A changed property makes Vue visit every element of the
// page.)

export default {
  template: "<section></section>",
  methods: {
    /** `anew`: also where the HTML is the same, so that a notice that is repeated is announced again.
     * @this {{ $el: HTMLElement }} @param {string} html @param {boolean} [anew] */
    show(html, anew = false) {
      const wanted = document.createElement("template");
      wanted.innerHTML = html;
      if (anew) this.$el.replaceChildren(wanted.content);
      else patch(this.$el, wanted.content);
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
