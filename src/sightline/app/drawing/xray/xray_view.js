// The NiceGUI component of the X-ray view: forwards calls and events, and keeps an edit while the server is away.

import { XrayCore } from "xray";

const REPLAY_MS = 1000; // after a reconnection the missed messages come first, including acknowledgements

export default {
  template: "<div></div>",
  props: { name: String, label: String, texts: Object },
  emits: ["xray"],
  mounted() {
    this.revision = null;
    this.core = new XrayCore(this.$el, {
      name: this.name,
      label: this.label,
      texts: this.texts,
      emit: (event) => this.$emit("xray", event),
      keep: (move) => this.keep(move),
    });
    this.disconnected = () => this.core.loseTouch();
    this.reconnected = () => setTimeout(() => this.settle(), REPLAY_MS);
    // The page opens its socket after this component.
    setTimeout(() => {
      if (!window.socket) return;
      window.socket.on("disconnect", this.disconnected);
      window.socket.io.on("reconnect", this.reconnected);
    });
  },
  unmounted() {
    if (window.socket) {
      window.socket.off("disconnect", this.disconnected);
      window.socket.io.off("reconnect", this.reconnected);
    }
    this.core.destroy();
  },
  methods: {
    // The first message after the page was built settles an edit left by a lost connection.
    show(message) {
      const first = !this.revision;
      if (!this.core.show(message)) return;
      this.revision = this.core.word.revision;
      if (first && this.revision) this.settle();
    },
    acknowledge(seq) {
      this.core.acknowledge(seq);
    },
    setFresh(url, ms) {
      this.core.setFresh(url, ms);
    },
    measured(label, note) {
      this.core.ruler.show(label, note);
    },
    sayLost(id) {
      this.core.edits.sayLost(id);
    },
    stashName() {
      return `sightline-xray-${this.name}`;
    },
    keep(move) {
      if (move) sessionStorage.setItem(this.stashName(), JSON.stringify({ move, revision: this.revision }));
      else sessionStorage.removeItem(this.stashName());
    },
    // Sends an unacknowledged edit again if the plan has not changed since.
    settle() {
      const stash = sessionStorage.getItem(this.stashName());
      if (stash === null) return;
      this.keep(null);
      const { move, revision } = JSON.parse(stash);
      if (revision && revision === this.revision && this.core.edits.resend(move)) return;
      this.core.giveUp();
      this.core.edits.sayLost(move.id);
    },
  },
};
