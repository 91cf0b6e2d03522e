// Options of the view: the map, the tint of invented pixels, and one camera or all.

import { MemoryMap } from './map.js';
import { MosaicMap } from './mosaic.js';

const $ = (id) => document.getElementById(id);

export class Views {
  /** `ask(show)` asks the server for what is shown alone. */
  constructor(screens, ask) {
    Object.assign(this, { screens, ask, worlds: [], mapAsked: false, show: { map: false, invented: false, cameras: [], futures: false } });
    this.places = new MemoryMap($('map'));
    this.mosaic = new MosaicMap($('map'));
    this.map = this.places;
    $('map-open').onclick = () => this.toggleMap();
    $('tint').onclick = () => this.toggleTint();
  }

  /** Takes the worlds of a greeting; those that were there before, in a story that goes on, are shown as they were. */
  take(worlds, { same, resumed }) {
    this.worlds = worlds;
    if (!resumed) { this.places.clear(); this.mosaic.clear(); }
    $('tint').hidden = !worlds.some((world) => world.knows_share);
    const wish = localStorage.getItem('terrella-map'), open = worlds.length === 1 ? wish !== 'closed' : wish === 'open';
    this.change(same ? {} : { map: open && innerWidth > 1000 });
  }

  /** Shows or hides the map, the tint or cameras. */
  change(change) {
    const { show } = this;
    Object.assign(show, change);
    show.map &&= this.worlds.some((world) => world.mapped);
    show.invented &&= this.worlds.some((world) => world.knows_share);
    this.showMap();
    $('map-open').setAttribute('aria-pressed', show.map);
    $('tint').setAttribute('aria-pressed', show.invented);
    for (const chip of $('cameras').children) chip.setAttribute('aria-pressed', chip.value === (show.cameras.length > 1 ? 'all' : show.cameras[0]));
    this.ask(show);
  }

  /** The map of the last world that has one, from when there is something to show or it was asked for; a mosaic, more than the picture. */
  showMap() {
    const kind = this.worlds.findLast((world) => world.mapped)?.mapped;
    const waits = this.show.map && !(kind === 'mosaic' ? this.mosaic.beyond : this.places.camera) && !this.mapAsked;
    this.map = kind === 'mosaic' ? this.mosaic : this.places;
    $('map').hidden = !this.show.map || waits;
    $('map-open').hidden = !kind || (kind === 'mosaic' && waits);
  }

  async onChart(body) {
    if (!this.show.map) return;
    await this.map.show(body);
    if (!$('map').hidden) return;
    this.showMap();
    this.map.draw();
  }

  toggleMap() {
    if ($('map-open').hidden) return;
    this.mapAsked = true;
    this.change({ map: !this.show.map });
    localStorage.setItem('terrella-map', this.show.map ? 'open' : 'closed');
  }

  toggleTint() {
    if (!$('tint').hidden) this.change({ invented: !this.show.invented });
  }

  /** The next camera, and after the last one all of them. */
  nextCamera() {
    const chips = [...$('cameras').children], at = chips.findIndex((chip) => chip.ariaPressed === 'true');
    if (chips.length) chips[(at + 1) % chips.length].click();
  }

  drawCameras() {
    const { cameras } = this.screens, chip = (value, textContent) => Object.assign(document.createElement('button'), { value, textContent });
    this.show.cameras = [cameras[0].channel];
    $('cameras').replaceChildren(...(cameras.length < 2 ? [] : [...cameras.map(({ channel, name }) => chip(channel, name)), chip('all', 'all')]));
    for (const button of $('cameras').children) button.onclick = () => {
      this.change({ cameras: button.value === 'all' ? cameras.map(({ channel }) => channel) : [button.value] });
      button.blur();
    };
  }

  /** Figures for tests. */
  get figures() {
    const { map, places, mosaic } = this;
    return { shown: !$('map').hidden, step: map.step, camera: places.camera, places: places.keys.length, path: places.path.length, size: mosaic.size };
  }
}
