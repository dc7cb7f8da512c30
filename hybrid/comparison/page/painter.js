// From codes to what is shown: the tone curve, scales of color, and finished pictures.

const ERROR_RANGE = 0.1; // of the tone curve: 20 dB at the bright end of the scale
const TILES_KEPT = 96;

const MAGMA = colorScale(["#000004", "#180f3d", "#440f76", "#721f81", "#9e2f7f", "#cd4071", "#f1605d", "#fd9668",
  "#feca8d", "#fcfdbf"]);
const VIRIDIS = colorScale(["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58",
  "#b5de2b", "#fde725"]);

const GRAYS = colorScale(["#000000", "#ffffff"]);

// 256 colors between stops, red, green and blue in turn.
function colorScale(stops) {
  const rgb = stops.map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)));
  const table = new Uint8ClampedArray(256 * 3);
  for (let i = 0; i < 256; i++) {
    const at = i / 255 * (rgb.length - 1), k = Math.min(Math.floor(at), rgb.length - 2);
    for (let c = 0; c < 3; c++) table[3 * i + c] = rgb[k][c] + (rgb[k + 1][c] - rgb[k][c]) * (at - k);
  }
  return { stops, table };
}

function scaleOfView(view) {
  if (/change/i.test(view)) return GRAYS; // its middle is what stays
  return view === "error" || /flip|error/i.test(view) ? MAGMA : VIRIDIS;
}

// A source of the player.
class Painter {
  constructor(pictures) {
    Object.assign(this, { pictures, frames: pictures.frames, sources: pictures.sources });
    this.tiles = new Map(); // finished pictures, by source, view and frame, at the exposure of `expose`
  }

  size() {
    return this.pictures;
  }

  label(source) {
    const { name } = this.sources[source];
    return [name, meanText(name, report.chart[0])];
  }

  image(source, { view, frame }) {
    return this.tile(source, view, frame);
  }

  // The tone curve at an exposure, and its sRGB bytes, of every code.
  expose(ev) {
    const gain = report.exposure * 2 ** ev;
    this.tone = this.pictures.radiance.map((x) => gain * x / (1 + gain * x));
    this.display = Uint8ClampedArray.from(this.tone, (t) =>
      255 * (t <= 0.0031308 ? 12.92 * t : 1.055 * t ** (1 / 2.4) - 0.055));
    this.tiles.clear();
  }

  // A canvas with one view of a source's frame; null where it has no such map.
  tile(source, view, frame) {
    const key = [source, view, frame].join("|");
    if (!this.tiles.has(key)) {
      if (this.tiles.size > TILES_KEPT) this.tiles.delete(this.tiles.keys().next().value);
      this.tiles.set(key, this.paint(source, view, frame));
    }
    return this.tiles.get(key);
  }

  async paint(source, view, frame) {
    const { width, height } = this.pictures, image = new ImageData(width, height);
    if (view === "picture") await this.paintPicture(image.data, source, frame);
    else if (view === "error") await this.paintError(image.data, source, frame);
    else if (!await this.paintMap(image.data, source, view, frame)) return null;
    const tile = makeCanvas(width, height);
    tile.getContext("2d").putImageData(image, 0, 0);
    return tile;
  }

  async paintPicture(out, source, frame) {
    const { count, lost } = this.pictures, codes = await this.pictures.colors(source, frame);
    for (let i = 0; i < count; i++) {
      const red = codes[i], green = codes[count + i], blue = codes[2 * count + i];
      if (red === lost || green === lost || blue === lost) put(out, i, 255, 0, 255); // magenta: not finite
      else put(out, i, this.display[red], this.display[green], this.display[blue]);
    }
  }

  async paintError(out, source, frame) {
    const { count } = this.pictures;
    const [codes, truth] = await Promise.all([this.pictures.colors(source, frame), this.pictures.colors(0, frame)]);
    for (let i = 0; i < count; i++) {
      let error = 0;
      for (let c = i; c < 3 * count; c += count) error += Math.abs(this.tone[codes[c]] - this.tone[truth[c]]) / 3;
      putScaled(out, i, MAGMA, Number.isNaN(error) ? 1 : Math.min(1, error / ERROR_RANGE));
    }
  }

  async paintMap(out, source, title, frame) {
    const levels = await this.pictures.map(source, title, frame);
    if (!levels) return false;
    const scale = scaleOfView(title), highest = this.pictures.mapLevels - 1;
    for (let i = 0; i < this.pictures.count; i++) putScaled(out, i, scale, levels[i] / highest);
    return true;
  }
}

function put(out, i, red, green, blue) {
  out[4 * i] = red;
  out[4 * i + 1] = green;
  out[4 * i + 2] = blue;
  out[4 * i + 3] = 255;
}

// The color of a share in [0, 1].
function putScaled(out, i, { table }, share) {
  const k = 3 * Math.round(255 * share);
  put(out, i, table[k], table[k + 1], table[k + 2]);
}
