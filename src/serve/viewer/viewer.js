// Shows /tileset.json in CesiumJS: no ion, no imagery, no terrain, no globe, so nothing but the tiles is fetched.
/* global Cesium */
import { Classes } from './classes.js';
import { inspect } from './inspect.js';
import * as panel from './panel.js';

const HOME = { heading: 30, pitch: -38 };
// A tileset whose middle is further than this from the Earth's surface is in local coordinates.
const SURFACE_M = 50e3;

const errors = [];
const classes = new Classes();
const state = { mode: 'texture', sse: 16, tint: 0.65 };
let widget, scene, tileset, frame, orbit = { ...HOME }, orbitFrom = null, pending = 0;

function fail(kind, message) {
  errors.push({ kind, message });
  panel.showErrors(errors);
}

async function loadScript(url) {
  await new Promise((done, failed) => {
    const script = Object.assign(document.createElement('script'), { src: url, onload: done });
    script.onerror = () => failed(new Error(`CesiumJS did not load from ${url}; without a network, run "npm ci" in tools/viewer and start the server again`));
    document.head.append(script);
  });
}

function makeScene() {
  Cesium.Ion.defaultAccessToken = '';
  widget = new Cesium.CesiumWidget('view', {
    baseLayer: false, globe: false, skyBox: false, skyAtmosphere: false, msaaSamples: 4, showRenderLoopErrors: false,
    requestRenderMode: true, maximumRenderTimeChange: Infinity,
    clock: new Cesium.Clock({ shouldAnimate: false }),
    contextOptions: { webgl: { alpha: true } },
  });
  scene = widget.scene;
  scene.backgroundColor = Cesium.Color.TRANSPARENT; // the page's own gradient is behind
  for (const body of [scene.sun, scene.moon]) if (body) body.show = false;
  scene.fog.enabled = false;
  scene.highDynamicRange = false;
  scene.renderError.addEventListener((_, error) => fail('render', `drawing stopped: ${error?.message ?? error}`));
}

async function makeTileset(url) {
  tileset = await Cesium.Cesium3DTileset.fromUrl(url, {
    maximumScreenSpaceError: state.sse,
    dynamicScreenSpaceError: false, foveatedScreenSpaceError: false, // what is set is what is drawn
    cullRequestsWhileMoving: false,
    enableDebugWireframe: true,
    environmentMapOptions: { enabled: false },
  });
  tileset.tileFailed.addEventListener((e) => fail('tile', `${decodeURIComponent(new URL(e.url, location.href).pathname)}: ${e.message}`));
  tileset.loadProgress.addEventListener((requests, processing) => { pending = requests + processing; });
  tileset.tileLoad.addEventListener((tile) => { if (classes.readTile(tile.content)) classesChanged(); });
  tileset.colorBlendMode = Cesium.Cesium3DTileColorBlendMode.MIX;
  const middle = tileset.boundingSphere.center;
  const ground = Cesium.Cartographic.fromCartesian(middle);
  if (!ground || Math.abs(ground.height) > SURFACE_M) {
    // Local metres, z up: put their middle on the equator, where east, north and up are known.
    const place = Cesium.Transforms.eastNorthUpToFixedFrame(Cesium.Cartesian3.fromDegrees(0, 0));
    tileset.modelMatrix = Cesium.Matrix4.multiplyByTranslation(place, Cesium.Cartesian3.negate(middle, new Cesium.Cartesian3()), new Cesium.Matrix4());
  }
  scene.primitives.add(tileset);
  frame = Cesium.Transforms.eastNorthUpToFixedFrame(tileset.boundingSphere.center);
  // Materials with lighting get an afternoon sun from the south-west, wherever they are.
  const sun = Cesium.Matrix4.multiplyByPointAsVector(frame, new Cesium.Cartesian3(0.45, 0.5, -0.75), new Cesium.Cartesian3());
  scene.light = new Cesium.DirectionalLight({ direction: Cesium.Cartesian3.normalize(sun, sun), intensity: 2.5 });
  if (classes.readSchema(tileset.schema)) classesChanged();
}

function classesChanged() {
  panel.showLegend(classes.colours);
  if (state.mode === 'class') applyMode();
}

function applyMode() {
  tileset.colorBlendAmount = state.tint;
  tileset.style = state.mode === 'class' ? classes.style() : undefined;
  scene.requestRender();
}

// ---- what the controls, the keys and scripts may do

function setMode(mode, tint = state.tint) {
  if (!['texture', 'class'].includes(mode)) throw new RangeError(`mode is 'texture' or 'class', not ${mode}`);
  Object.assign(state, { mode, tint });
  panel.showMode(mode);
  panel.showTint(tint);
  applyMode();
}

function setSse(pixels) {
  if (!(pixels > 0)) throw new RangeError(`a screen-space error is above 0 px, not ${pixels}`);
  state.sse = tileset.maximumScreenSpaceError = pixels;
  panel.showSse(pixels);
  scene.requestRender();
}

/** Looks at the middle of the tileset: degrees clockwise from north, degrees above the horizon (down is negative), metres. */
function view({ heading = orbit.heading, pitch = orbit.pitch, range = orbit.range } = {}) {
  look({ heading, pitch, range, about: frame });
}

/** Looks at the origin of the frame `about`. */
function look({ heading, pitch, range, about }) {
  scene.camera.cancelFlight();
  const { toRadians } = Cesium.Math;
  scene.camera.lookAtTransform(about, new Cesium.HeadingPitchRange(toRadians(heading), toRadians(pitch), range));
  scene.camera.lookAtTransform(Cesium.Matrix4.IDENTITY); // leaves the camera there but free to move
  orbit = { heading, pitch, range, about };
  orbitFrom = scene.camera.position.clone();
  scene.requestRender();
}

/** Turns about what is in the middle of the view; angles in degrees, `zoom` as a factor of the distance. */
function turn(heading, pitch, zoom) {
  const { camera, canvas } = scene, { toDegrees } = Cesium.Math;
  if (!orbitFrom?.equals(camera.position)) { // the mouse moved it since
    const middle = scene.pickPosition(new Cesium.Cartesian2(canvas.clientWidth / 2, canvas.clientHeight / 2)) ?? tileset.boundingSphere.center;
    const range = Cesium.Cartesian3.distance(camera.position, middle);
    orbit = { heading: toDegrees(camera.heading), pitch: toDegrees(camera.pitch), range, about: Cesium.Transforms.eastNorthUpToFixedFrame(middle) };
  }
  look({ heading: orbit.heading + heading, pitch: Math.max(-89, Math.min(-2, orbit.pitch + pitch)), range: orbit.range * zoom, about: orbit.about });
}

function home(seconds) {
  const { toRadians } = Cesium.Math, sphere = tileset.boundingSphere;
  orbit = { ...HOME, range: 2.1 * Math.max(sphere.radius, 1) };
  if (!seconds) return view();
  const offset = new Cesium.HeadingPitchRange(toRadians(orbit.heading), toRadians(orbit.pitch), orbit.range);
  return new Promise((done) => scene.camera.flyToBoundingSphere(sphere, { duration: seconds, offset, complete: done, cancel: done }));
}

function stats() {
  const counts = tileset.statistics; // not part of the public interface: may be absent in another release
  return {
    tiles: counts?.selected ?? null,
    triangles: counts?.numberOfTrianglesSelected ?? null,
    gpuBytes: tileset.totalMemoryUsageInBytes,
    loading: pending,
    sse: tileset.maximumScreenSpaceError,
    mode: state.mode,
    classes: Object.fromEntries(classes.colours),
    failed: errors.filter((e) => e.kind === 'tile').length,
  };
}

function pick(x, y) {
  const found = inspect(scene.pick(new Cesium.Cartesian2(x, y)), [...classes.colours.keys()]);
  panel.card(found, classes.colours);
  scene.requestRender(); // a pick leaves only the tiles under the pixel selected
  return found;
}

/** Draws until nothing is left to load for this view (3 frames in a row), at most for `timeoutMs`. */
async function settle(timeoutMs = 30000) {
  const start = performance.now();
  let frames = 0, calm = 0;
  while (calm < 3 && performance.now() - start < timeoutMs) {
    scene.requestRender();
    widget.render();
    calm = ++frames > 1 && tileset.tilesLoaded ? calm + 1 : 0;
    if (calm < 3) await new Promise((next) => requestAnimationFrame(next));
  }
  return { settled: calm >= 3, ms: performance.now() - start, frames };
}

/** Draws a frame and counts its pixels: the share that shows the tileset, and exact colours with 0.1 % or more. */
function colours() {
  scene.requestRender();
  widget.render();
  const { canvas } = scene, copy = Object.assign(document.createElement('canvas'), { width: canvas.width, height: canvas.height });
  const drawing = copy.getContext('2d');
  drawing.drawImage(canvas, 0, 0);
  const px = drawing.getImageData(0, 0, copy.width, copy.height).data, total = px.length / 4, count = new Map();
  let drawn = 0;
  for (let i = 0; i < px.length; i += 4) {
    if (px[i + 3] === 0) continue;
    drawn++;
    const key = (px[i] << 16) | (px[i + 1] << 8) | px[i + 2];
    count.set(key, (count.get(key) ?? 0) + 1);
  }
  const many = [...count].filter(([, n]) => n >= total / 1000).sort((a, b) => b[1] - a[1]);
  return { drawn: drawn / total, distinct: count.size, shares: Object.fromEntries(many.map(([key, n]) => [`#${key.toString(16).padStart(6, '0')}`, n / total])) };
}

function bindCanvas() {
  const { canvas } = scene;
  canvas.tabIndex = 0;
  canvas.setAttribute('aria-label', '3D view of the tileset; the arrow keys turn it');
  new Cesium.ScreenSpaceEventHandler(canvas).setInputAction((click) => pick(click.position.x, click.position.y), Cesium.ScreenSpaceEventType.LEFT_CLICK);
  const keys = {
    ArrowLeft: () => turn(5, 0, 1), ArrowRight: () => turn(-5, 0, 1), ArrowUp: () => turn(0, -3, 1), ArrowDown: () => turn(0, 3, 1),
    '+': () => turn(0, 0, 0.9), '=': () => turn(0, 0, 0.9), '-': () => turn(0, 0, 1.1), Home: () => home(0.6),
    Enter: () => pick(canvas.clientWidth / 2, canvas.clientHeight / 2),
  };
  canvas.addEventListener('keydown', (e) => {
    if (!keys[e.key] || e.ctrlKey || e.metaKey || e.altKey) return;
    e.preventDefault();
    keys[e.key]();
  });
}

async function start() {
  const config = await (await fetch('/viewer/config.json')).json();
  panel.showConfig(config);
  window.CESIUM_BASE_URL = config.cesium;
  await loadScript(`${config.cesium}Cesium.js`);
  makeScene();
  await makeTileset(config.tileset);
  bindCanvas();
  panel.bind({
    mode: setMode, sse: setSse, tint: (share) => setMode(state.mode, share),
    boxes: (on) => { tileset.debugShowBoundingVolume = on; scene.requestRender(); },
    wireframe: (on) => { tileset.debugWireframe = on; scene.requestRender(); },
  });
  panel.showSse(state.sse);
  setInterval(() => panel.showStats(stats()), 250);
  panel.showStatus('');
  const still = navigator.webdriver || matchMedia('(prefers-reduced-motion: reduce)').matches;
  await home(still ? 0 : 1.2);
}

const started = start();
started.catch((error) => {
  panel.showStatus('');
  // CesiumJS rejects with its own RequestErrorEvent, whose text is on the status.
  fail('load', error?.statusCode ? `tileset.json: the server answered ${error.statusCode}` : String(error?.message ?? error));
});

/** For scripts and tests; the page itself uses the same functions. */
window.rooftile = {
  ready: () => started, settle, setSse, setMode, view, stats, pick, colours, errors,
};
