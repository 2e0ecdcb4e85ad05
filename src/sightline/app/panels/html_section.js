// HTML that comes as a message: only this element is updated. (A changed property makes Vue visit every element of the
// page.)

export default {
  template: "<section></section>",
  methods: {
    /** @this {{ $el: HTMLElement }} @param {string} html */
    show(html) {
      this.$el.innerHTML = html;
    },
  },
};
