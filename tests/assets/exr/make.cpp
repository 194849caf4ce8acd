// Writes luminance-chroma pictures by OpenEXR itself (RgbaOutputFile with WRITE_YC), and to luma.csv what it reads of them again.
//
//     g++ -o make make.cpp $(pkg-config --cflags --libs OpenEXR) && ./make
//
// Made with OpenEXR 3.1.5. Nothing is random.

#include <ImfHeader.h>
#include <ImfRgbaFile.h>
#include <cmath>
#include <fstream>
#include <string>
#include <vector>

int main() {
    const int w = 96, h = 64;
    std::vector<Imf::Rgba> pixels(w * h), again(w * h);
    for (int y = 0; y < h; y++)
        for (int x = 0; x < w; x++) {
            const double sun = std::hypot(x - 60, y - 14) < 5 ? 30 : 0;
            pixels[y * w + x] = Imf::Rgba(float(1 + 0.5 * std::sin(x / 9.0) + sun), float(0.8 + 0.3 * std::cos(y / 7.0) + sun),
                                          float(0.6 + 0.2 * std::sin((x + y) / 6.0) + 0.8 * sun));
        }
    const struct { const char *name; Imf::Compression kind; } kinds[] = {
        {"zips", Imf::ZIPS_COMPRESSION}, {"zip", Imf::ZIP_COMPRESSION}, {"piz", Imf::PIZ_COMPRESSION}, {"pxr24", Imf::PXR24_COMPRESSION}, {"b44", Imf::B44_COMPRESSION}};
    std::ofstream table("luma.csv");
    table << "file,x,y,r,g,b\n";
    for (const auto &kind : kinds) {
        const std::string file = std::string("luma-") + kind.name + ".exr";
        {
            Imf::Header header(w, h);
            header.compression() = kind.kind;
            Imf::RgbaOutputFile out(file.c_str(), header, Imf::WRITE_YC);
            out.setFrameBuffer(pixels.data(), 1, w);
            out.writePixels(h);
        }
        Imf::RgbaInputFile in(file.c_str());
        in.setFrameBuffer(again.data(), 1, w);
        in.readPixels(0, h - 1);
        for (int i = 0; i < w * h; i += 37) {
            const Imf::Rgba &p = again[i];
            table << kind.name << ',' << i % w << ',' << i / w << ',' << float(p.r) << ',' << float(p.g) << ',' << float(p.b) << '\n';
        }
    }
}
