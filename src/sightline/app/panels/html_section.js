// HTML that comes as a message: the element is filled anew, and the page around it is left alone. (A property that
// changes makes Vue go through every element there is.)

export default {
  template: "<section></section>",
  methods: {
    show(html) {
      this.$el.innerHTML = html;
    },
  },
};
