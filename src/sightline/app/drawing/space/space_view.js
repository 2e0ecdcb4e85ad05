// The NiceGUI component of the scene: forwards calls. Tests access the core as window.sightlineSpace.

import { SpaceCore } from "space";

export default {
  template: '<div style="position: relative; width: 100%; height: 100%"></div>',
  props: { label: String, groups: Object, texts: Object },
  mounted() {
    this.core = new SpaceCore(this.$el, { label: this.label, groups: this.groups, texts: this.texts });
    window.sightlineSpace = this.core;
  },
  unmounted() {
    if (window.sightlineSpace === this.core) delete window.sightlineSpace;
    this.core.destroy();
  },
  methods: {
    draw(name, objects) {
      this.core.update(name, objects);
    },
    orient(side) {
      this.core.orient(side);
    },
  },
};
