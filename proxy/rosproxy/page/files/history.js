// The rates of the links in the last minute: pure functions, without a DOM. Nothing but this page
// keeps these values.

import { megabytes } from "./view.js";

export const SECONDS = 60;

// Rates by link, each a ring: the rate of a second is at the second modulo SECONDS. `next` is the
// first second that is not recorded.
export function emptyHistory(now) {
  return { rings: new Map(), next: Math.floor(now / 1000) };
}

// Record the rates of all seconds that have ended since the last time. A rate holds until an update
// changes it. Nothing is known of seconds after `knownUntil`. Times are in milliseconds.
export function record(history, links, now, knownUntil) {
  const end = Math.floor(now / 1000);
  if (end < history.next - SECONDS) Object.assign(history, emptyHistory(now)); // the clock was set back
  const { rings } = history;
  for (const id of rings.keys()) if (!links.has(id)) rings.delete(id);
  for (let second = Math.max(history.next, end - SECONDS); second < end; second += 1) {
    const isKnown = second * 1000 <= knownUntil;
    for (const [id, { rate }] of links) {
      if (!rings.has(id) && isKnown && Number.isFinite(rate)) rings.set(id, new Float32Array(SECONDS).fill(NaN));
      if (rings.has(id)) rings.get(id)[second % SECONDS] = isKnown ? rate ?? NaN : NaN;
    }
  }
  history.next = Math.max(history.next, end);
}

// The rates of a link in bytes per second, the oldest first and the rate of now last; NaN if not
// known. Nothing if no rate of the minute is known.
export function lastMinute(history, id, link) {
  const ring = history.rings.get(id) || new Float32Array(SECONDS).fill(NaN);
  const past = Array.from(ring, (_, index) => ring[(history.next + index) % SECONDS]);
  const values = [...past.slice(1), link.rate ?? NaN];
  return values.some(Number.isFinite) ? values : [];
}

// The way of a curve in a picture of this size. Seconds that are not known are gaps.
export function curveOf(values, width, height) {
  const most = Math.max(...values.filter(Number.isFinite)) || 1;
  const parts = values.map((value, index) => {
    if (!Number.isFinite(value)) return "";
    const x = (index * width) / (values.length - 1);
    const at = `${x.toFixed(1)},${(height - (height * value) / most).toFixed(1)}`;
    // A line of no length is a dot: of a second between two gaps.
    return Number.isFinite(values[index - 1]) ? `L${at}` : `M${at}h0`;
  });
  return parts.join("");
}

// The same in words. `shared`: see `megabytes`.
export function minuteText(values, shared) {
  const known = values.filter(Number.isFinite);
  const [least, most] = [Math.min(...known), Math.max(...known)].map((rate) => megabytes({ rate, shared }));
  const gaps = values.length - known.length;
  return `${least === most ? most : `${least} to ${most}`} MB/s in the last minute${gaps ? `, ${gaps} s not known` : ""}`;
}
