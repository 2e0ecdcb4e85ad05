// Sends files, one after another, to the address of their target.
// File names and the server's sentences are only ever shown as text.

const PAGE = "position:fixed;inset:0;z-index:7000;display:flex;gap:16px;padding:24px;background:rgba(8,12,18,.86)";
const PANEL =
  "flex:1;display:flex;align-items:center;justify-content:center;border:2px dashed;border-radius:16px;font-size:1.6rem";

/** Resolves to null once the file is received, or to the server's sentence on why not.
 * @param {File} file @param {string} address @param {(part: number) => void} onProgress
 * @returns {Promise<string | null>} */
function send(file, address, onProgress) {
  return new Promise((resolve) => {
    const request = new XMLHttpRequest(); // fetch reports no progress
    request.open("POST", address);
    request.setRequestHeader("X-File-Name-End", file.name.replace(/[^.\w]/g, "").slice(-16));
    request.upload.onprogress = (event) => {
      if (event.total) onProgress(event.loaded / event.total);
    };
    request.onload = () => resolve(request.status === 200 ? null : sentence(request));
    request.onerror = () => resolve("the file did not reach the app; is it still running?");
    request.send(file);
  });
}

/** @param {XMLHttpRequest} request @returns {string} */
function sentence(request) {
  try {
    return JSON.parse(request.responseText).error;
  } catch {
    return request.responseText || `refused (${request.status})`;
  }
}

/** @type {import("./types").Component & ThisType<import("./types").Drop>} */
const drop = {
  template: `
    <div class="drop-row" v-show="!told || Object.keys(states).length">
      <template v-for="(target, i) in targets" :key="target.address">
        <q-btn v-show="!told || target.label in states" outline no-caps icon="upload_file" :label="called(target)" :loading="busy === i"
               :percentage="percent" @click="$refs.inputs[i].click()"></q-btn>
        <input ref="inputs" type="file" multiple hidden :aria-label="called(target)" :data-testid="'drop-' + target.label"
               :accept="accept" @change="chosen($event, i)">
      </template>
      <span data-testid="drop-message" role="status" :class="{ 'drop-bad': bad }">{{ message }}</span>
      <template v-for="(target, i) in targets" :key="'in-' + target.address">
        <teleport v-if="asks(i)" :to="'#' + target.box">
          <div :class="['drop-in', states[target.label]]" :data-testid="'drop-in-' + target.label">
            <div v-if="states[target.label] === 'empty'" class="drop-word">{{ "Drop the " + (names[target.label] ?? target.label) + " here" }}</div>
            <div v-if="failed === i" class="drop-bad" role="alert">{{ message }}</div>
            <div v-if="states[target.label] === 'empty'" class="drop-or">or</div>
            <button type="button" class="action primary" @click="$refs.inputs[i].click()">
              {{ states[target.label] === "empty" ? "Choose a file" : "Load another image" }}</button>
          </div>
        </teleport>
      </template>
      <teleport to="body">
        <div v-if="dragging" style="${PAGE}" data-testid="drop-page">
          <div v-for="target in shown" :key="target.address" @dragenter="over = target" @drop.prevent="dropped($event, target)"
               :style="'${PANEL};' + place(target) + (over === target ? 'border-color:var(--sky);color:var(--sky)' : 'border-color:var(--edge);color:var(--text)')"
               :data-testid="'drop-panel-' + target.label">{{ called(target) }}</div>
        </div>
      </teleport>
    </div>`,
  props: { targets: Array, maxBytes: Number, most: Number, smaller: String, accept: String },
  data: () => ({
    ready: false,
    told: false,
    states: {},
    names: {},
    labels: {},
    dragging: false,
    over: null,
    busy: null,
    waiting: [],
    percent: 0,
    message: "",
    bad: false,
    failed: null,
  }),
  computed: {
    shown() {
      return this.told ? this.targets.filter(({ label }) => label in this.states) : this.targets;
    },
  },
  mounted() {
    this.ready = true; // the boxes are in the page now
    this.listeners = {
      dragenter: (event) => this.dragged(event),
      dragover: (event) => this.dragged(event),
      dragleave: (event) => {
        if (!event.relatedTarget) this.leave();
      },
      drop: (event) => {
        event.preventDefault(); // a file dropped beside the panels must not replace the page
        this.leave();
      },
    };
    for (const [name, listener] of Object.entries(this.listeners)) window.addEventListener(name, listener);
  },
  unmounted() {
    for (const [name, listener] of Object.entries(this.listeners)) window.removeEventListener(name, listener);
  },
  methods: {
    // What each target shows now: empty, here or failed; files for others are not taken.
    tell(states, names, labels) {
      this.told = true;
      this.states = states;
      this.names = names;
      this.labels = labels;
    },
    // What its button says: which image it takes on this step.
    called({ label }) {
      return this.labels[label] ?? label;
    },
    // A target says in its box that it wants an image: it has none, or one that failed.
    asks(i) {
      const { box, label } = this.targets[i];
      const first = this.targets.findIndex((other) => other.box === box) === i;
      return this.ready && Boolean(box) && first && label in this.states && (this.states[label] !== "here" || this.failed === i);
    },
    // Over its box; targets that share one divide it.
    place(target) {
      const box = target.box && document.getElementById(target.box);
      if (!box) return "";
      const same = this.shown.filter((other) => other.box === target.box);
      const { left, top, width, height } = box.getBoundingClientRect();
      const part = height / same.length;
      return `position:absolute;box-sizing:border-box;left:${left}px;top:${top + part * same.indexOf(target)}px;width:${width}px;height:${part}px;`;
    },
    dragged(event) {
      if (!this.shown.length || !event.dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      this.dragging = true;
    },
    leave() {
      this.dragging = false;
      this.over = null;
    },
    chosen(event, target) {
      const files = [...(event.target.files ?? [])];
      event.target.value = ""; // so that the same file can be chosen again
      this.take(files, target);
    },
    dropped(event, target) {
      this.take([...event.dataTransfer.files], this.targets.indexOf(target));
    },
    // Several files dropped at once go to this target and the following ones, one after another.
    async take(files, target) {
      if (files.length > this.most) return this.say(`at most ${this.most} files at a time`, true);
      files.forEach((file, n) => this.waiting.push([file, (target + n) % this.targets.length]));
      if (this.busy !== null) return;
      for (let next = this.waiting.shift(); next; next = this.waiting.shift()) await this.hand(...next);
    },
    async hand(file, target) {
      if (file.size > this.maxBytes) {
        const size = Math.floor(this.maxBytes / 1e6);
        return this.say(`${file.name} has more than ${size} MB; ${this.smaller}`, true);
      }
      this.busy = target;
      this.percent = 0;
      this.failed = null;
      this.say(`reading ${file.name}`, false);
      const onProgress = (/** @type {number} */ part) => {
        this.percent = 100 * part;
      };
      const refusal = await send(file, this.targets[target].address, onProgress);
      this.busy = null;
      this.failed = refusal ? target : null;
      this.say(refusal ? `${file.name}: ${refusal}` : "", Boolean(refusal));
    },
    say(message, bad) {
      this.message = message;
      this.bad = bad;
    },
  },
};

export default drop;
