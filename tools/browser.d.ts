// What the page's scripts use besides the browser's standard library of TypeScript's Debian package.

interface Window {
  sightlineXray: Record<string, import("../src/sightline/app/drawing/xray/xray").XrayCore>;
  /** The connection of the page, Socket.IO; undefined until the page is built. */
  socket?: { connected: boolean; emit(event: "alive", answered: () => void): void };
  /** What the server calls. */
  sightlineOpened(): void;
  sightlineLeave(): void;
}

/** Tells the server's page (NiceGUI). */
declare function emitEvent(name: string, ...args: unknown[]): void;

interface Element {
  checkVisibility(): boolean;
}

interface Array<T> {
  findLast(accepts: (value: T) => boolean): T | undefined;
}
