#include "fastloop/io/image_file.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "fastloop/io/test_support.hpp"

namespace fastloop::io {
namespace {

using testing::AllOf;
using testing::HasSubstr;

TEST(ImageFile, PngIsReadExactly) {
  const TemporaryFolder folder;
  const ImageU8 image = pattern(41, 23, 3);
  write_image(folder.path() / "a.png", image);
  const ImageU8 read = read_grey_image(folder.path() / "a.png");
  EXPECT_EQ(read.width, 41);
  EXPECT_EQ(read.height, 23);
  EXPECT_EQ(read.pixels, image.pixels);
}

TEST(ImageFile, JpegIsReadClosely) {
  const TemporaryFolder folder;
  const ImageU8 image = pattern(64, 32, 0);
  write_image(folder.path() / "a.jpg", image);
  const ImageU8 read = read_grey_image(folder.path() / "a.jpg");
  ASSERT_EQ(read.pixels.size(), image.pixels.size());
  EXPECT_NEAR(read.at(5, 5), image.at(5, 5), 12);
}

TEST(ImageFile, ColourBecomesGreyByLuminance) {
  const TemporaryFolder folder;
  write_colour_image(folder.path() / "c.png", 8, 8, 200, 100, 50);
  EXPECT_NEAR(read_grey_image(folder.path() / "c.png").at(3, 3),
              0.299 * 200 + 0.587 * 100 + 0.114 * 50, 1.01);
}

TEST(ImageFile, SixteenBitsKeepTheirUpperEight) {
  const TemporaryFolder folder;
  Image<std::uint16_t> image(4, 1);
  image.pixels = {0, 256, 40000, 65535};
  write_image(folder.path() / "t.png", image);
  EXPECT_EQ(count_significant_bits(folder.path() / "t.png"), 16);
  EXPECT_THAT(read_grey_image(folder.path() / "t.png").pixels,
              testing::ElementsAre(0, 1, 156, 255));
  image.pixels = {0, 16, 4095, 2048};
  write_image(folder.path() / "t.png", image);
  EXPECT_EQ(count_significant_bits(folder.path() / "t.png"), 12);
  EXPECT_THAT(read_grey_image(folder.path() / "t.png", 12).pixels,
              testing::ElementsAre(0, 1, 255, 128));
}

TEST(ImageFile, DepthIsInMetresAndUnknownIsZero) {
  const TemporaryFolder folder;
  Image<std::uint16_t> image(3, 1);
  image.pixels = {0, 65535, 7500};
  write_image(folder.path() / "d.png", image);
  EXPECT_THAT(read_depth_image(folder.path() / "d.png", 5000).pixels,
              testing::ElementsAre(0, 0, 1.5F));
  write_image(folder.path() / "grey.png", pattern(8, 8, 0));
  EXPECT_THAT(input_error([&] { read_depth_image(folder.path() / "grey.png", 5000); }),
              AllOf(HasSubstr("grey.png"), HasSubstr("16-bit")));
}

TEST(ImageFile, EveryTruncationIsAnError) {
  const TemporaryFolder folder;
  for (const char* name : {"a.png", "a.jpg"}) {
    const auto path = folder.path() / name;
    write_image(path, pattern(64, 48, 1));
    const std::string whole = read_text_file(path);
    for (std::size_t size = 0; size + 1 < whole.size(); size += size < 64 ? 1 : 37) {
      write_text_file(path, whole.substr(0, size));
      EXPECT_THAT(input_error([&] { read_grey_image(path); }), HasSubstr(name)) << size;
    }
    write_text_file(path, whole.substr(0, whole.size() / 2));
    EXPECT_THAT(input_error([&] { read_grey_image(path); }),
                AllOf(HasSubstr("ends early"), HasSubstr("complete")));
    write_text_file(path, whole + std::string(16, '\0'));
    EXPECT_EQ(read_grey_image(path).width, 64) << "padding after the end is harmless";
  }
}

TEST(ImageFile, DamagedPngIsAnError) {
  const TemporaryFolder folder;
  const auto path = folder.path() / "a.png";
  ImageU8 noise(64, 64);
  unsigned value = 1;
  for (auto& p : noise.pixels)
    p = static_cast<std::uint8_t>((value = value * 1664525U + 1013904223U) >> 24);
  write_image(path, noise);
  std::string bytes = read_text_file(path);
  for (std::size_t i = bytes.size() / 2; i < bytes.size() / 2 + 8; ++i)
    bytes[i] = static_cast<char>(~bytes[i]);
  write_text_file(path, bytes);
  EXPECT_THAT(input_error([&] { read_grey_image(path); }),
              AllOf(HasSubstr("a.png"), HasSubstr("damaged")));
}

TEST(ImageFile, OtherFilesAreNamed) {
  const TemporaryFolder folder;
  EXPECT_THAT(input_error([&] { read_grey_image(folder.path() / "none.png"); }),
              AllOf(HasSubstr("none.png"), HasSubstr("does not exist")));
  const auto text = folder.write("text.png", "hello");
  EXPECT_THAT(input_error([&] { read_grey_image(text); }), HasSubstr("neither PNG nor JPEG"));
  const auto empty = folder.write("empty.png", "");
  EXPECT_THAT(input_error([&] { read_grey_image(empty); }), HasSubstr("empty file"));
}

}  // namespace
}  // namespace fastloop::io
