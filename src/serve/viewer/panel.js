// The controls: reads them, writes them, knows nothing of CesiumJS.

const $ = (id) => document.getElementById(id);

function element(tag, text, attributes = {}) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

function swatch(colour) {
  const made = element('span', undefined, { class: 'swatch' });
  made.style.background = colour;
  return made;
}

/** Metres, so that a millimetre and a kilometre can both be read. */
export function metres(m) {
  if (!Number.isFinite(m)) return '–';
  const size = Math.abs(m);
  if (size !== 0 && size < 0.0995) return `${+(m * 1000).toPrecision(3)} mm`;
  return size < 1000 ? `${+m.toPrecision(3)} m` : `${+(m / 1000).toPrecision(4)} km`;
}

const number = (n) => Number(n).toLocaleString('en-US', { maximumSignificantDigits: 4 });
/** `geometryError` → `geometry error` */
const title = (id) => id.replace(/([a-z0-9])([A-Z])/g, '$1 $2').replaceAll('_', ' ').toLowerCase();
/** The schema says which numbers are metres. */
const isMetres = (what) => /\b(metres|meters)\b/.test(what);
const shown = (value, inMetres) => (typeof value === 'number' ? (inMetres ? metres(value) : number(value)) : String(value));

/** @param actions { mode(name), sse(pixels), tint(share), boxes(on), wireframe(on), closed() } */
export function bind(actions) {
  for (const radio of document.querySelectorAll('[name=mode]')) radio.addEventListener('change', () => actions.mode(radio.value));
  $('sse').addEventListener('input', () => actions.sse(2 ** $('sse').valueAsNumber));
  $('tint').addEventListener('input', () => actions.tint($('tint').valueAsNumber / 100));
  $('boxes').addEventListener('change', () => actions.boxes($('boxes').checked));
  $('wireframe').addEventListener('change', () => actions.wireframe($('wireframe').checked));
  $('card-close').addEventListener('click', () => card(null));
  addEventListener('keydown', (e) => { if (e.key === 'Escape') card(null); });
}

export function showConfig({ version, cesium }) {
  $('version').textContent = version;
  $('source').textContent = cesium.startsWith('/') ? 'CesiumJS from this server' : `CesiumJS from ${new URL(cesium).host}`;
}
export function showMode(mode) {
  document.querySelector(`[name=mode][value=${mode}]`).checked = true;
  $('tint-row').hidden = mode !== 'class';
}
export function showSse(pixels) {
  const text = `${+pixels.toPrecision(2)} px`;
  $('sse').value = Math.log2(pixels);
  $('sse').setAttribute('aria-valuetext', text);
  $('sse-value').textContent = text;
}
export function showTint(share) {
  $('tint').value = 100 * share;
  $('tint-value').textContent = `${Math.round(100 * share)} %`;
}
export function showLegend(colours) {
  $('legend').replaceChildren(...[...colours].map(([name, colour]) => {
    const item = element('li');
    item.append(swatch(colour), element('span', name));
    return item;
  }));
}
export function showStats({ tiles, triangles, gpuBytes, loading }) {
  const known = (value, text) => (value === null ? '–' : text);
  $('tiles').textContent = known(tiles, number(tiles));
  $('triangles').textContent = known(triangles, number(triangles));
  $('gpu').textContent = `${(gpuBytes / 1e6).toFixed(1)} MB`;
  $('loading').textContent = known(loading, loading === 0 ? 'done' : number(loading));
}
export function showStatus(text) { $('status').textContent = text; }
export function showErrors(errors) {
  const last = errors.at(-1), tiles = errors.filter((e) => e.kind === 'tile').length;
  $('error').hidden = !last;
  if (last) $('error').textContent = `${tiles > 1 ? `${tiles} tiles failed, the last: ` : ''}${last.message}`;
}

/** Shows what `inspect` found; null closes the card. */
export function card(found, colours = new Map()) {
  $('card').hidden = !found;
  if (!found) return;
  const heading = element('h2');
  if (found.class !== null) heading.append(swatch(colours.get(found.class) ?? 'transparent'));
  heading.append(found.class ?? 'no class');
  const list = element('dl');
  const row = (name, value, what = '') => {
    const line = element('div', undefined, { title: what });
    line.append(element('dt', name), element('dd', value));
    list.append(line);
  };
  row('tile', found.uri);
  row('level', found.level);
  row('geometric error', metres(found.geometricError), 'What viewers refine by: the written geometricError of this tile');
  if (found.triangles) row('triangles in the tile', number(found.triangles));
  for (const [id, { value, what }] of Object.entries(found.metadata)) {
    if (id in found) continue; // said above
    row(title(id), Array.isArray(value) ? value.map((v) => shown(v, isMetres(what))).join(', ') : shown(value, isMetres(what)), what);
  }
  for (const [id, value] of Object.entries(found.feature)) {
    if (value !== undefined && value !== found.class) row(title(id), shown(value, false));
  }
  const parts = [heading, list];
  if (Object.keys(found.perClass).length) parts.push(table(found.perClass, colours));
  $('card-body').replaceChildren(...parts);
}

/** One column a measure, one row a class that has any. */
function table(perClass, colours) {
  const made = element('table'), head = element('tr'), measures = Object.entries(perClass);
  head.append(element('th', 'class', { scope: 'col' }));
  for (const [id, { what }] of measures) head.append(element('th', title(id), { title: what, scope: 'col' }));
  made.append(head);
  for (const [name, colour] of colours) {
    if (measures.every(([, { values }]) => values[name] === undefined)) continue;
    const line = element('tr'), first = element('th', undefined, { scope: 'row' });
    first.append(swatch(colour), ` ${name}`);
    line.append(first);
    for (const [, { values, what }] of measures) line.append(element('td', values[name] === undefined ? '–' : shown(values[name], isMetres(what))));
    made.append(line);
  }
  const box = element('div', undefined, { class: 'wide' });
  box.append(made);
  return box;
}
