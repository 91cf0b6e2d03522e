// Who drives: the button, the words below the picture, and the agent's action on the keys and sliders.

const $ = (id) => document.getElementById(id);
const LINGERS_MS = 1800;

export class DriverView {
  /** send(message); say(sentence); quiet() lets go of all controls; light(held) lights key caps; axes: sliders (axes.js); go(): play goes on. */
  constructor(hooks) {
    Object.assign(this, hooks, { there: false, driving: false, name: '', timer: 0, held: [] });
    $('drive').onclick = () => { this.toggle(); $('drive').blur(); };
  }

  /** Takes what a greeting says. */
  take({ agent }) {
    this.there = !!agent;
    $('drive').hidden = !agent;
  }

  toggle() {
    if (!this.there) return;
    if (!this.driving) { this.quiet(); this.go(); }
    this.send({ type: 'drive', on: !this.driving });
  }

  /** An event `agent` (see serve/protocol.py). */
  show(body) {
    const { driving, name, said, thinks_ms: ms, away, unit } = body;
    if (said && said !== this.said) this.say(said);
    const handed = this.driving && !driving;
    Object.assign(this, { driving, name, said });
    $('app').classList.toggle('driven', driving);
    $('drive').setAttribute('aria-pressed', driving);
    $('drive').title = driving ? 'Drive yourself (G, or any key of the world)' : `Let the agent drive${name ? `: ${name}` : ''} (G)`;
    if (driving) {
      $('driver-name').textContent = name ? `${name[0].toUpperCase()}${name.slice(1)} drives` : 'The agent is starting';
      const facts = [away !== null && `${away}${unit ? ` ${unit}` : ''} to go`, ms >= 5 && `thinks ${ms < 1000 ? `${ms} ms` : `${ms / 1000} s`}`].filter(Boolean);
      $('driver-more').textContent = [...facts, $('app').classList.contains('touchable') ? 'touch to take over' : 'any key takes over'].join(' · ');
    } else if (handed) {
      [$('driver-name').textContent, $('driver-more').textContent] = ['You drive', ''];
    }
    if (driving || handed) {
      clearTimeout(this.timer);
      $('driver').classList.add('show');
      if (handed) this.timer = setTimeout(() => $('driver').classList.remove('show'), LINGERS_MS);
    }
  }

  /** An event `acted`: the agent's action as keys and axes; nothing of either where the person acts. */
  acted({ held, axes }) {
    this.held = held;
    this.light(held);
    this.axes.follow(axes.length ? axes : null);
  }
}
