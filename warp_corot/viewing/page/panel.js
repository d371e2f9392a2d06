// The controls: what they show, and what they ask for.

const HINTS = {
  'drag,': 'Drag the body to pull it',
  'press,': 'Press on the body and move the mouse away to push in',
  'grasp,': 'Drag the body; it stays where you leave it',
  'drag,ball': 'Drag the ball against the body',
  'drag,rod': 'Drag the rod against the body',
  'drag,knife': 'Drag the knife through the body',
  'grasp,ball': 'Bring the ball to the body, then press on it again to grip',
};
const VIEW = 'drag beside it to turn · wheel: zoom · right button: move · double click: fit';
const SAVES = {
  picture: ['Picture', 'The scene as you see it, as PNG'],
  film: ['Film', 'The scene from now on, as MP4 or GIF'],
  animation: ['Animation', 'A USD animation, for Blender, Houdini or Omniverse'],
  checkpoint: ['Checkpoint', 'The state of the simulation, for Simulation.load'],
  'run file': ['Run file', 'The options of this run, for warp-corot simulate'],
  'end early': ['Stop', 'End a film or an animation now; what there is of it is kept'],
};
const SLIDERS = ['radius', 'strength', 'speed'], CHOICES = ['colors', 'surface', 'world'], FLAGS = ['remesh', 'weight'];
const MODULI = { young: 1e3, poisson: 1, density: 1 };  // and their units

const $ = id => document.getElementById(id), panel = $('panel');
const isInUse = control => document.activeElement === control;
let page, noted = '', hiding;

function setChoices(select, entries, value) {
  const text = JSON.stringify(entries);
  if (select.dataset.entries !== text) {
    select.replaceChildren(...entries.map(([key, label = key]) => new Option(label, key)));
    select.dataset.entries = text;
  }
  if (!isInUse(select)) select.value = value;
}

function setSlider(slider, value) {
  slider.value = value;
  slider.nextElementSibling.textContent = slider.name === 'speed' ? `${value} ×` : `${Math.round(100 * value)} %`;
}

export function showPage(told) {
  page = told;
  const { controls, tissue, choices, sources } = page, mode = `${controls.hand},${page.tool}`;
  document.title = $('title').textContent = page.title;
  $('elements').textContent = `${page.elements.toLocaleString('en')} tetrahedra`;
  $('hint').textContent = `${HINTS[mode] || HINTS['drag,']} · ${VIEW}`;
  for (const hand of panel.hand) hand.checked = hand.value === mode;
  for (const name of SLIDERS) if (!isInUse(panel[name])) setSlider(panel[name], controls[name]);
  setChoices(panel.colors, [...Object.entries(sources).map(([name, [label]]) => [name, label]), ['', 'none']],
    controls.colors in sources ? controls.colors : '');
  setChoices(panel.surface, page.surfaces.map(name => [name]), controls.surface || page.surfaces[0]);
  setChoices(panel.world, Array.from({ length: page.worlds }, (_, k) => [String(k)]), controls.world);
  $('worlds').hidden = page.worlds < 2;
  $('axis').value = controls.plane?.axis || '';
  $('share').disabled = $('flip').disabled = !controls.plane;
  showTissue(tissue, choices);
  $('pause').textContent = controls.running ? 'Pause' : 'Go on';
  $('step').disabled = controls.running;
  showSaves([...page.saves, 'end early']);
  showNote();
}

function showTissue(tissue, choices) {
  setChoices(panel.law, choices.laws.map(name => [name]), tissue.law);
  setChoices(panel.rotations, choices.rotations.map(name => [name]), tissue.rotations);
  panel.rotations.disabled = tissue.law !== 'corotated';
  panel.poisson.disabled = !choices.poisson;
  for (const name of FLAGS) {
    panel[name].checked = tissue[name];
    panel[name].disabled = !choices[name];
  }
  for (const [name, unit] of Object.entries(MODULI)) {
    if (!isInUse(panel[name])) panel[name].value = +(tissue[name] / unit).toPrecision(4);
  }
  const isLike = each => Object.keys(MODULI).every(name => Math.abs(each[name] / tissue[name] - 1) < 1e-3);
  const known = page.tissues.find(isLike);
  setChoices($('tissue'), [['', 'own values'], ...page.tissues.map(each => [each.name])], known?.name || '');
  $('tissue').title = known ? known.source : 'Tissues with values from the literature';
}

function showSaves(names) {
  if ($('saves').childElementCount !== names.length) {
    $('saves').replaceChildren(...names.map(name => {
      const [textContent, title] = SAVES[name];
      return Object.assign(document.createElement('button'), { type: 'button', name, textContent, title });
    }));
  }
  for (const button of $('saves').children) button.disabled = (button.name === 'end early') !== page.busy;
}

function showNote() {
  if (page.note === noted) return;
  noted = page.note;
  if (noted) $('note').textContent = noted;
  clearTimeout(hiding);
  if (!page.busy) hiding = setTimeout(() => { $('note').textContent = ''; }, noted ? 10000 : 3000);
}

// Let the controls ask the server, by messages; a tool comes to the place that `beside` gives.
export function listen(send, beside) {
  const change = what => send({ do: 'change', what }), mix = what => send({ do: 'tissue', what });
  const on = (control, event, act) => control.addEventListener(event, () => {
    act(control);
    if (event === 'change') control.blur();
  });
  for (const name of SLIDERS) {
    on(panel[name], 'input', slider => {
      setSlider(slider, +slider.value);
      change({ [name]: +slider.value });
    });
  }
  for (const name of CHOICES) on(panel[name], 'change', select => change({ [name]: select.value }));
  for (const name of ['law', 'rotations']) on(panel[name], 'change', select => mix({ [name]: select.value }));
  for (const name of FLAGS) on(panel[name], 'change', box => mix({ [name]: box.checked }));
  for (const [name, unit] of Object.entries(MODULI)) {
    on(panel[name], 'change', input => {
      if (input.value && input.checkValidity()) mix({ [name]: unit * input.value });
      else showPage(page);
    });
  }
  on($('tissue'), 'change', select => {
    const chosen = page.tissues.find(each => each.name === select.value);
    const names = Object.keys(MODULI).filter(name => !panel[name].disabled);
    if (chosen) mix(Object.fromEntries(names.map(name => [name, chosen[name]])));
  });
  for (const hand of panel.hand) {
    hand.addEventListener('change', () => {
      const [kind, tool] = hand.value.split(',');
      change({ hand: kind });
      if (tool !== page.tool) send({ do: 'use tool', name: tool, at: beside() });
    });
  }
  const cut = flipped => {
    const axis = $('axis').value, share = +$('share').value;
    change({ plane: axis ? { axis, share, flipped } : null });
  };
  const isFlipped = () => page.controls.plane?.flipped || false;
  on($('axis'), 'change', () => cut(isFlipped()));
  on($('share'), 'input', () => cut(isFlipped()));
  on($('flip'), 'click', () => cut(!isFlipped()));
  const pause = () => change({ running: !page.controls.running });
  on($('pause'), 'click', pause);
  for (const name of ['step', 'reset', 'release']) on($(name), 'click', () => send({ do: name }));
  $('saves').addEventListener('click', ({ target: { name } }) => {
    if (name) send(name === 'end early' ? { do: name } : { do: 'save', what: name, seconds: +$('seconds').value || 4 });
  });
  panel.addEventListener('submit', event => event.preventDefault());
  addEventListener('keydown', event => {
    if (event.code !== 'Space' || event.target.closest('input, select, button, summary')) return;
    event.preventDefault();
    pause();
  });
}
