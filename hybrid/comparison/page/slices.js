// One row of the pictures through time: a band of each source, and its difference from the reference.

class Slices {
  constructor(pictures, painter, state) {
    Object.assign(this, { pictures, painter, state });
    this.draws = 0;
    this.bands = pictures.sources.map((source, i) => this.addBands(source, i === 0));
  }

  addBands(source, isReference) {
    const name = make("div", source.name), figure = meanText(source.name, "temporal_psnr");
    if (figure) name.append(make("small", `temporal PSNR ${figure}`));
    const { width, frames } = this.pictures;
    const bands = ["picture", "difference from the reference"].map((what) => {
      const band = makeCanvas(width, frames.length);
      band.style.height = clamp(84 / frames.length, 5, 14) * frames.length + "px";
      band.setAttribute("role", "img");
      band.setAttribute("aria-label", `${source.name}: ${what}, one row through time`);
      return band;
    });
    if (isReference) bands[1].style.visibility = "hidden";
    find("slices").append(name, ...bands);
    return bands;
  }

  async draw() {
    const mine = ++this.draws, { width, frames, sources } = this.pictures;
    for (let source = 0; source < sources.length; source++) {
      const shown = new ImageData(width, frames.length), wrong = new ImageData(width, frames.length);
      for (let frame = 0; frame < frames.length; frame++) await this.paintRow(shown.data, wrong.data, source, frame);
      if (mine !== this.draws) return; // a newer one is in progress
      this.bands[source][0].getContext("2d").putImageData(shown, 0, 0);
      this.bands[source][1].getContext("2d").putImageData(wrong, 0, 0);
    }
  }

  // One line of both bands: the row of a frame, and orange where it is too bright, blue where it is too dark.
  async paintRow(shown, wrong, source, frame) {
    const { width, count } = this.pictures, { tone, display } = this.painter;
    const [codes, truth] = await Promise.all([this.pictures.colors(source, frame), this.pictures.colors(0, frame)]);
    for (let x = 0, i = this.state.row * width, k = frame * width; x < width; x++, i++, k++) {
      const rgb = [codes[i], codes[count + i], codes[2 * count + i]];
      const error = rgb.reduce((sum, code, c) => sum + (tone[code] - tone[truth[c * count + i]]) / 3, 0);
      const strength = Math.min(1, Math.abs(error) / ERROR_RANGE) ** 0.7;
      const hue = error > 0 ? [255, 165, 60] : [70, 165, 255];
      put(shown, k, ...rgb.map((code) => display[code]));
      put(wrong, k, ...hue.map((value) => Number.isNaN(error) ? 255 : value * strength));
    }
  }
}
