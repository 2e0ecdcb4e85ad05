// What the page's scripts use besides the browser's standard library of TypeScript's Debian package.

interface Window {
  sightlineXray: Record<string, import("../src/sightline/app/drawing/xray/xray").XrayCore>;
}

interface Element {
  checkVisibility(): boolean;
}

interface Array<T> {
  findLast(accepts: (value: T) => boolean): T | undefined;
}
