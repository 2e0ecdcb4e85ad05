// What the row of upload buttons keeps, and what the server tells it (panels/drop.py). For the type checker alone.

/** Where files go: `box` is the id of the element that shows the image. */
export interface Target {
  label: string;
  address: string;
  box?: string;
}

export type State = "empty" | "here" | "failed";

export interface Data {
  ready: boolean;
  told: boolean;
  states: Record<string, State>;
  /** Of their images, as in a sentence. */
  names: Record<string, string>;
  /** Of their buttons, where not the target's own. */
  labels: Record<string, string>;
  dragging: boolean;
  over: Target | null;
  /** The target that a file is sent to now, or that refused the last one. */
  busy: number | null;
  failed: number | null;
  waiting: [File, number][];
  percent: number;
  message: string;
  bad: boolean;
}

export interface Methods {
  tell(states: Record<string, State>, names: Record<string, string>, labels: Record<string, string>): void;
  called(target: Target): string;
  asks(i: number): boolean;
  place(target: Target): string;
  dragged(event: DragEvent): void;
  leave(): void;
  chosen(event: Event & { target: HTMLInputElement }, target: number): void;
  dropped(event: DragEvent & { dataTransfer: DataTransfer }, target: Target): void;
  take(files: File[], target: number): Promise<void>;
  hand(file: File, target: number): Promise<void>;
  say(message: string, bad: boolean): void;
}

export interface Listeners {
  dragenter(event: DragEvent): void;
  dragover(event: DragEvent): void;
  dragleave(event: DragEvent): void;
  drop(event: DragEvent): void;
}

/** The component at work. */
export type Drop = Data & Methods & { targets: Target[]; maxBytes: number; most: number; smaller: string; accept: string; shown: Target[]; listeners: Listeners };

/** Its definition for Vue. */
export interface Component {
  template: string;
  props: object;
  data: () => Data;
  computed: { shown(): Target[] } & ThisType<Drop>;
  mounted(): void;
  unmounted(): void;
  methods: Methods & ThisType<Drop>;
}
