// The timeline: playing, stepping and scrubbing.

import { byId, context2d, nearestIndex } from './page.js';

/** @typedef {import('./page.js').App} App */
/** @typedef {import('./page.js').Command} Command */

const THUMB = 16;
const LABEL_SPACE = 64;

/** Plays the scene. */
export class Player {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.samples = app.scene.timeline.samples;
    this.root = byId('player', HTMLElement);
    this.scrub = byId('scrub', HTMLInputElement);
    this.time = byId('time', HTMLOutputElement);
    this.ticks = byId('ticks', HTMLCanvasElement);
    this.root.hidden = !this.moves;
    if (!this.moves) return;
    this.scrub.min = String(this.first);
    this.scrub.max = String(this.last);
    this.scrub.addEventListener('input', () => this.seek(Number(this.scrub.value)));
    const speed = byId('speed', HTMLSelectElement);
    speed.addEventListener('change', () => app.set({ speed: Number(speed.value) }));
    new ResizeObserver(() => this.drawTicks()).observe(this.ticks);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.drawTicks());
    app.listen((changed) => {
      if (changed.has('code') || changed.has('playing')) this.show();
    });
    this.show();
  }

  /** @returns {number} */
  get first() {
    return this.samples[0] ?? 0;
  }

  /** @returns {number} */
  get last() {
    return this.samples.at(-1) ?? 0;
  }

  /** @returns {boolean} True when there is more than one time. */
  get moves() {
    return this.last > this.first;
  }

  show() {
    const { code, playing } = this.app.state;
    const frame = playing ? Math.round(code) : Number(code.toFixed(2));
    const seconds = (code / this.app.scene.timeline.per_second).toFixed(2);
    this.root.dataset.playing = String(playing);
    this.scrub.value = String(code);
    this.scrub.setAttribute('aria-valuetext', `Frame ${frame}, ${seconds} seconds`);
    this.time.textContent = `${frame} / ${Number(this.last.toFixed(2))}   ${seconds} s`;
  }

  /**
   * Stops at the sample that is nearest to a time code.
   * @param {number} code
   */
  seek(code) {
    if (this.moves) this.app.set({ playing: false, code: this.samples[nearestIndex(this.samples, code)] });
  }

  /** @param {number} count Samples to go forward; round to the other end where it loops. */
  step(count) {
    if (!this.moves) return;
    const next = nearestIndex(this.samples, this.app.state.code) + count;
    const length = this.samples.length;
    const index = this.app.state.loop ? (next + length) % length : Math.max(0, Math.min(length - 1, next));
    this.app.set({ playing: false, code: this.samples[index] });
  }

  toggle() {
    if (!this.moves) return;
    const { playing, code } = this.app.state;
    if (playing) this.seek(code);
    else this.app.set({ playing: true, code: code >= this.last ? this.first : code });
  }

  /**
   * Goes on by the seconds since the last frame, however long that took to draw.
   * @param {number} seconds
   */
  advance(seconds) {
    const { playing, code, speed, loop } = this.app.state;
    if (!playing) return;
    const next = code + seconds * speed * this.app.scene.timeline.per_second;
    if (next <= this.last) this.app.set({ code: next });
    else if (loop) this.app.set({ code: this.first + ((next - this.first) % (this.last - this.first)) });
    else this.app.set({ code: this.last, playing: false });
  }

  drawTicks() {
    const ratio = window.devicePixelRatio;
    const { clientWidth: width, clientHeight: height } = this.ticks;
    if (!width) return;
    this.ticks.width = Math.round(width * ratio);
    this.ticks.height = Math.round(height * ratio);
    const context = context2d(this.ticks);
    context.scale(ratio, ratio);
    context.fillStyle = getComputedStyle(this.ticks).color;
    context.font = `11px ${getComputedStyle(this.ticks).fontFamily}`;
    context.textAlign = 'center';
    const scale = (width - THUMB) / (this.last - this.first);
    /** @type {(code: number, length: number) => void} */
    const tick = (code, length) =>
      context.fillRect(Math.round(THUMB / 2 + (code - this.first) * scale), 0, 1, length);
    const dense = (this.samples.length - 1) * 4 > width;
    if (!dense) this.samples.forEach((code) => tick(code, 3));
    const step = niceStep(LABEL_SPACE / scale);
    for (let code = Math.ceil(this.first / step) * step; code <= this.last + 1e-9; code += step) {
      tick(code, 6);
      context.fillText(
        String(Number(code.toFixed(3))),
        THUMB / 2 + (code - this.first) * scale,
        17,
        LABEL_SPACE,
      );
    }
  }
}

/**
 * The smallest of 1, 2 and 5 times a power of ten that is not less.
 * @param {number} least
 * @returns {number}
 */
export function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * ([1, 2, 5].find((factor) => factor * power >= least * (1 - 1e-9)) ?? 10);
}

/**
 * @param {App} app
 * @param {Player} player
 * @returns {Command[]}
 */
export function playerCommands(app, player) {
  const group = 'Time';
  const toggleLoop = () => app.set({ loop: !app.state.loop });
  return [
    { id: 'play', group, name: 'Play or pause', key: ' ', run: () => player.toggle() },
    { id: 'back', group, name: 'Previous frame', key: 'ArrowLeft', run: () => player.step(-1) },
    { id: 'back-comma', group, name: 'Previous frame', key: ',', run: () => player.step(-1) },
    { id: 'forward', group, name: 'Next frame', key: 'ArrowRight', run: () => player.step(1) },
    { id: 'forward-point', group, name: 'Next frame', key: '.', run: () => player.step(1) },
    { id: 'first', group, name: 'First frame', key: 'Shift+ArrowLeft', run: () => player.seek(player.first) },
    { id: 'last', group, name: 'Last frame', key: 'Shift+ArrowRight', run: () => player.seek(player.last) },
    { id: 'loop', group, name: 'Loop', run: toggleLoop, on: () => app.state.loop },
  ];
}
